"""What the code of a task may take while it is checked."""

from __future__ import annotations

from dataclasses import dataclass

GIBIBYTE = 2**30


@dataclass(frozen=True)
class Limits:
    """What a task's code may take.

    Arguments:
        seconds: One call of it [s].
        memory_bytes: The process that runs it.
    """

    seconds: float = 60.0
    memory_bytes: int = 4 * GIBIBYTE
