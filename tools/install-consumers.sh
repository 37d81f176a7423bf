#!/bin/sh
# Install the programs that tests give exported files and pages to: a browser, Gazebo's reader of SDF, and ROS's
# reader of URDF, from Debian's or Ubuntu's packages. Never fails: where one is missing, its tests are skipped and say why.
#
#   tools/install-consumers.sh
there() {
    command -v chromium >/dev/null && command -v check_urdf >/dev/null && pkg-config --exists sdformat12 2>/dev/null
}
there && exit 0
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing the readers of exported files: chromium, libsdformat, check_urdf"
    export DEBIAN_FRONTEND=noninteractive
    timeout 600 sh -c 'apt-get -qq update && apt-get -qq install --yes --no-install-recommends \
        chromium pkg-config libsdformat-dev liburdfdom-tools' >/dev/null 2>&1
fi
there || echo "Not all readers of exported files are here: tests that need them are skipped and say why"
exit 0
