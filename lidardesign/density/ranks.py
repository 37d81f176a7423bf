"""Learning on several ranks at once: what a rank does with its part of the work, and how parts become wholes.

All ranks draw the same random numbers and hold the same flow. Each takes its share of the batch through the flow and
its share of the scenes through the target (`parallel_target`); gradients are summed, so that every rank takes the
step that one process alone would take, to rounding. The first rank alone writes and prints.

`Ranks` is one process alone, for which every operation is the identity: code written for ranks costs it nothing.
`parallel_ranks` connects several.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    import torch

Rows = TypeVar("Rows", "np.ndarray", "torch.Tensor")


@dataclass(frozen=True)
class Ranks:
    """The processes that learn one density together; this one alone unless a launcher started several.

    Arguments:
        rank: The number of this process, from 0.
        size: How many there are.
        local_rank: Its number on its computer: which GPU is its own.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0

    @property
    def first(self) -> bool:
        """Whether this is the rank that writes and prints."""
        return self.rank == 0

    def rows_of(self, count: int, rank: int | None = None) -> slice:
        """Which of `count` rows a rank takes, this one by default: even blocks in order, the first ones longer."""
        rank = self.rank if rank is None else rank
        each, left = divmod(count, self.size)
        start = rank * each + min(rank, left)
        return slice(start, start + each + (rank < left))

    def part(self, rows: Rows) -> Rows:
        """This rank's block of rows that all ranks hold."""
        return rows if self.size == 1 else rows[self.rows_of(len(rows))]

    def gather(self, rows: Rows, *, of: int | None = None) -> Rows:
        """The rows of all ranks, in order.

        Arguments:
            rows: Any number on each rank.
            of: How many all have together, where each brings its `part` of them: nobody then has to ask.
        """
        return rows

    def stacked(self, values: np.ndarray) -> np.ndarray:
        """The arrays of all ranks, of one shape, one behind the other: shape (size, *)."""
        return self.gather(values[None], of=self.size)

    def gathered(self, rows: np.ndarray) -> tuple[np.ndarray, slice]:
        """The rows of all ranks, in order, and which of them this rank brought."""
        return rows, slice(0, len(rows))

    def sum(self, values: np.ndarray) -> np.ndarray:
        """The elementwise sum over all ranks."""
        return values

    def max(self, values: np.ndarray) -> np.ndarray:
        """The elementwise largest value over all ranks."""
        return values

    def share(self, content: bytes) -> bytes:
        """What the first rank gives, on all ranks."""
        return content

    def mean(self, values: np.ndarray) -> float:
        """The mean of the values that all ranks bring, any number each; 0 without any."""
        total, count = self.sum(np.array([values.sum(), values.size], dtype=np.float64))
        return float(total / count) if count else 0.0

    def sum_gradients(self, parameters: Iterable[torch.nn.Parameter], *, valid: bool) -> None:
        """Add up the gradients of all ranks in place; NaN everywhere when those of one rank are not `valid`."""

    def spread(self, evaluate: Callable[[np.ndarray], np.ndarray], rows: np.ndarray) -> np.ndarray:
        """What a function makes of rows that all ranks hold, each rank evaluating its part of them."""
        return self.gather(evaluate(self.part(rows)), of=len(rows))

    def of_first(self, rows: np.ndarray) -> np.ndarray:
        """The rows of the first rank, on all ranks: what may differ by the rounding of other processors."""
        if self.size == 1:
            return rows
        return np.frombuffer(self.share(rows.tobytes()), dtype=rows.dtype).reshape(-1, *rows.shape[1:]).copy()

    def announce(self, job: dict[str, Any]) -> None:
        """Let the first rank tell the others what comes next; they wait for it in `parallel_learn.follow`."""
        if self.first and self.size > 1:
            self.share(json.dumps(job).encode())

    def agree(self, what: str, content: bytes) -> None:
        """Check that all ranks hold the same.

        Raises:
            ConfigError: They do not.
        """
        found = self.stacked(np.frombuffer(hashlib.sha256(content).digest(), dtype=np.uint8))
        others = [rank for rank, row in enumerate(found) if not np.array_equal(row, found[0])]
        if others:
            raise ConfigError(
                f"rank {others[0]} has other {what} than rank 0",
                where="torchrun",
                hint="start all ranks with the same command, files and versions of the packages",
            )

    def tell(self) -> None:
        """Note for the others that this rank says what went wrong."""

    def is_told(self) -> bool:
        """Whether the first rank says what went wrong, after the moment that it may need for it."""
        return False

    def leave(self) -> None:
        """Part from the others, when all is done."""

    def state_of_first(
        self, read: Callable[[], tuple[dict[str, np.ndarray], dict[str, Any]]]
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays and plain state that the first rank reads, on all ranks: the others need not see its files."""
        if self.size == 1:
            return read()
        from safetensors.numpy import load, save

        arrays, state = read() if self.first else ({}, {})
        content = self.share(save(arrays) if self.first else b"")
        return load(content), json.loads(self.share(json.dumps(state).encode()))


ALONE = Ranks()
