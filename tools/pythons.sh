# To be sourced: `found_python VERSION` prints the path of that Python, or says that it is not here and fails.
found_python() {
    local found=("${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$1".*/bin/python) python
    python="${found[-1]}"
    [ -x "$python" ] || python="$(command -v "python$1" || true)"
    # a shim of pyenv may stand for a Python that it does not run
    [ -n "$python" ] && "$python" -c "" 2> /dev/null || { echo "Python $1 is not here" >&2; return 1; }
    echo "$python"
}

# `room_for_python VERSION` says that there is no room for an environment, and fails: PyTorch for some Pythons brings its
# libraries for graphics cards, 7 GB while it is installed.
room_for_python() {
    local free_gb
    free_gb="$(df -Pk . | awk 'END { print int($4 / 1048576) }')"
    [ "$free_gb" -ge 8 ] || { echo "Python $1 needs 8 GB, $free_gb are free: left out" >&2; return 1; }
}
