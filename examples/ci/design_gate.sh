#!/bin/sh
# A quality gate for LiDAR designs: fails where one scores worse than it may in held-out scenes.
#
#   design_gate.sh RUN LIMIT [DESIGN...]
#
# RUN is learned from lidar.yaml where it is not there yet. Without a DESIGN, one is fitted to it under constraints.yaml.
# LIMIT is in the task's own unit. With BASELINE in the environment, a baseline or another design, every design must also be
# better than it by the interval of the difference. Exit codes are those of lidardesign: 0 good enough, 1 not good enough,
# above that something went wrong. What can be looked at goes to gate/: rows.csv, result.json, report.html.
set -eu
run=$1 limit=$2
shift 2
rays=${RAYS:-196}
baseline=${BASELINE:-}
out=${OUT:-gate}
mkdir -p "$out"

if [ ! -e "$run/samples.npz" ]; then
    lidardesign learn --config lidar.yaml --out "$run" --quiet
fi
if [ $# -eq 0 ]; then
    lidardesign constrain "$run" --constraints constraints.yaml --rays "$rays" --name gate --quiet
    set -- "$run/designs/gate.yaml"
fi

code=0
lidardesign evaluate "$@" --rays "$rays" --fail-above "$limit" ${baseline:+--fail-unless-better "$baseline"} \
    --csv "$out/rows.csv" --report "$out/report.html" --json >"$out/result.json" || code=$?
case $code in
    0) echo "good enough: at most $limit${baseline:+ and better than $baseline} with $rays rays" ;;
    1) echo "worse than $limit${baseline:+ or not better than $baseline} with $rays rays: see $out/report.html" ;;
    *) echo "not scored: exit code $code" ;;
esac
exit "$code"
