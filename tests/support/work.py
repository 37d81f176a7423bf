"""Work that does not end well, for processes of their own."""

import ctypes
import os
import sys
import time


def aborts(*_):
    print("a banner")
    print("LLVM ERROR: Cannot select", file=sys.stderr, flush=True)
    os.abort()


def crashes(*_):
    ctypes.string_at(0)


def hangs(*_):
    time.sleep(600)


def leaves(*_):
    os._exit(3)


def repeats(request, answers):
    """Says each line that it is sent, to be told apart from what it prints."""
    for line in sys.stdin:
        print("not an answer", flush=True)
        answers.write(line.encode())
        answers.flush()
    return request


def shouts(_, answers):
    answers.write(b"hello\n")
    return {}


def returns(request, _):
    return request
