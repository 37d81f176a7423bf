#!/usr/bin/env bash
# Builds sdist and wheel into dist/, installs the wheel with every Python from 3.11 to 3.13 that is found, each in an empty
# environment under build/, which goes again, and runs the demo with it.
set -euo pipefail
. "$(dirname "$0")/pythons.sh"
rm -rf dist
"$1" -m build --no-isolation --outdir dist . > /dev/null
ls dist
for version in 3.11 3.12 3.13; do
    python="$(found_python "$version")" && room_for_python "$version" || continue
    place="build/dist-$version"
    echo "Python $version: installing the wheel, running the demo"
    trap 'rm -rf "$place"' EXIT
    rm -rf "$place"
    "$python" -m venv "$place"
    PYTHONWARNINGS=ignore "$place/bin/python" -m pip install --quiet --constraint constraints.txt dist/*.whl
    # from elsewhere, so that the checkout's own package is not found
    (cd "$place" && bin/python ../../examples/demo.py --out demo | tail -n 25)
    rm -rf "$place"
done
