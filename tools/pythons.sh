# To be sourced: `found_python VERSION` prints the path of that Python, or says that it is not here and fails.
found_python() {
    local found=("${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$1".*/bin/python) python
    python="${found[-1]}"
    [ -x "$python" ] || python="$(command -v "python$1" || true)"
    # a shim of pyenv may stand for a Python that it does not run
    [ -n "$python" ] && "$python" -c "" 2> /dev/null || { echo "Python $1 is not here" >&2; return 1; }
    echo "$python"
}
