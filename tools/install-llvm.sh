#!/bin/sh
# Make the light-transport simulator usable where that is possible: it needs an LLVM library, version 19 or newer, which
# Debian and Ubuntu have as libllvm19. Never fails: without it, the tests that need it are skipped and say why.
#
#   tools/install-llvm.sh PYTHON
missing() {
    "$1" -c 'from lidardesign.simulate.light_transport.transport import missing; print(missing() or "")'
}
reason=$(missing "$1") || exit 0
case "$reason" in
"" | "not installed"*) ;;
*)
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        echo "Installing libllvm19 for the light-transport simulator"
        export DEBIAN_FRONTEND=noninteractive
        timeout 300 sh -c 'apt-get -qq update && apt-get -qq install --yes --no-install-recommends libllvm19' \
            >/dev/null 2>&1
    fi
    reason=$(missing "$1")
    ;;
esac
[ -z "$reason" ] || echo "The light-transport simulator cannot run here ($reason): its tests are skipped"
exit 0
