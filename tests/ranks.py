"""Several ranks in tests: real processes, connected as a launcher connects them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

SMALL_WAIT_S = 120


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def start_ranks(size: int, *arguments: str, **environment: str) -> list[subprocess.Popen]:
    """`python ARGUMENTS` as so many ranks of this computer."""
    common = {
        **os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "WORLD_SIZE": str(size),
        "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parent), **environment,
    }  # fmt: skip
    common.pop("COLUMNS", None)
    return [
        subprocess.Popen(
            [sys.executable, *arguments], cwd=Path(__file__).parent,
            env={**common, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for rank in range(size)
    ]  # fmt: skip


def finished(ranks: list[subprocess.Popen]) -> list[tuple[int, str, str]]:
    """Exit code, stdout and stderr of every rank, once all have ended."""
    try:
        outputs = [rank.communicate(timeout=SMALL_WAIT_S) for rank in ranks]
    finally:
        for rank in ranks:
            rank.kill()
            rank.wait()
    return [(rank.returncode, out, err) for rank, (out, err) in zip(ranks, outputs, strict=True)]


def in_ranks(size: int, code: str, **environment: str) -> None:
    """Run Python in so many ranks; fails with what they said unless all end well."""
    ended = finished(start_ranks(size, "-c", code, **environment))
    assert all(status == 0 for status, _, _ in ended), "\n".join(err for _, _, err in ended)
