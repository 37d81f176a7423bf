#!/bin/sh
# Makes a virtual environment and says what will be downloaded into it, or what to install first.
#
#   tools/environment.sh PYTHON FOLDER
stop() {
    echo "$*" >&2
    exit 1
}
versions='import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))'
"$1" -c "$versions" 2>/dev/null ||
    stop "Python 3.11, 3.12 or 3.13 is needed, and $1 is none: name one with make PYTHON=/path/to/python3"
"$1" -c 'import ensurepip' 2>/dev/null ||
    stop "$1 cannot make virtual environments: install them first (Debian, Ubuntu: apt install python3-venv)"
"$1" -m venv "$2" || exit 1
"$2/bin/python" -m pip install --quiet --upgrade pip || exit 1
# Linux alone has two kinds of wheels, one with the libraries of graphics cards
torch=$("$2/bin/python" -m pip install --quiet --dry-run --ignore-installed --no-deps --constraint constraints.txt --report - torch 2>/dev/null |
    grep -o '"version": "[^"]*"' | tail -n 1)
case "$(uname -s) $torch" in
Linux*+cpu* | [!L]*) size="0.4 GB are downloaded, 1.7 GB installed (torch for the processor alone)" ;;
*) size="3 GB are downloaded, 6 GB installed (torch with its libraries for graphics cards; docs/install.md has less)" ;;
esac
echo "Setting up $2, once: $size"
