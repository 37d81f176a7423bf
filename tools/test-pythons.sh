#!/usr/bin/env bash
# Installs the project with every Python from 3.11 to 3.13 that is found, but for the one given, and runs the core's
# tests. Each has a folder of its own under build/, which goes when its tests have run.
set -euo pipefail
. "$(dirname "$0")/pythons.sh"
own="$("$1" -c 'import sys; print("%d.%d" % sys.version_info[:2])')"
core=(tests/test_numerics.py tests/test_space.py tests/test_config.py tests/scenes/test_meshio.py tests/density/test_quality.py
    tests/density/test_splines.py tests/simulate/test_plan.py tests/rays tests/fitting/test_part_design.py tests/api/test_api.py)
for version in 3.11 3.12 3.13; do
    [ "$version" = "$own" ] && continue
    python="$(found_python "$version")" && room_for_python "$version" || continue
    place="build/python$version"
    trap 'rm -rf "$place"' EXIT
    echo "Python $version: installing"
    "$python" -m venv "$place"
    PYTHONWARNINGS=ignore "$place/bin/python" -m pip install --quiet --constraint constraints.txt '.[test]'
    "$place/bin/python" -m pytest -q -n 2 "${core[@]}"
    rm -rf "$place"
done
