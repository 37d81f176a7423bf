"""Several ranks connected by torch.distributed: gloo between processes, nccl between their GPUs.

`torchrun`, and whatever else sets RANK, WORLD_SIZE, MASTER_ADDR and MASTER_PORT, starts them. When a rank dies, the
sockets to it close, and whatever the others wait for ends in a `LostRankError`.

What the ranks after the first do: whatever the first one announces, until it says that all is done.

Only the first rank knows the command line and the run folder. It announces every ground that it prepares and every
training that it starts (`Ranks.announce`), with the configuration: the others need neither its files nor its options.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, distributed

from lidardesign.config import config_of
from lidardesign.density.learn import learn
from lidardesign.density.ranks import ALONE, Ranks, Rows
from lidardesign.density.training.training_data import Ground, prepare_ground
from lidardesign.errors import ConfigError, LostRankError
from lidardesign.run.yaml import Document

# The longest that a rank may keep the others waiting: building the fields of its scenes can take minutes.
PATIENCE = timedelta(minutes=30)
MEETING = timedelta(minutes=10)
MOST_PORT = 65_535
# Another rank's message arrives on the launcher's own store within a fraction of this.
TOLD_WITHIN = timedelta(seconds=2)

TOLD = "told"


def join_ranks(environment: dict[str, str] | os._Environ[str] = os.environ) -> Ranks:
    """Meet the other ranks that a launcher's environment tells of; this process alone where it tells of none.

    Raises:
        ConfigError: The environment is not one that a launcher makes.
        LostRankError: The others cannot be reached.
    """
    size = _number(environment, "WORLD_SIZE", 1)
    if size == 1:
        return ALONE
    rank, local_rank = _number(environment, "RANK", 0, size - 1), _number(environment, "LOCAL_RANK", 0)
    _number(environment, "MASTER_PORT", 1, MOST_PORT)
    if not distributed.is_available():
        raise ConfigError("this torch was built without torch.distributed", where="WORLD_SIZE", allowed="1")
    store, _, _ = _met(lambda: next(distributed.rendezvous("env://", rank, size, timeout=MEETING)))
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() and distributed.is_nccl_available() else "gloo"
    own = distributed.PrefixStore("lidardesign", store)
    _met(lambda: distributed.init_process_group(backend, store=own, rank=rank, world_size=size, timeout=PATIENCE))
    return ConnectedRanks(rank, size, local_rank, store=distributed.PrefixStore("messages", store))


def _number(environment: Any, name: str, lowest: int, highest: int | None = None) -> int:
    text = environment.get(name, str(lowest))
    if text.isdecimal() and lowest <= int(text) and (highest is None or int(text) <= highest):
        return int(text)
    allowed = f"a whole number from {lowest}" + ("" if highest is None else f" to {highest}")
    raise ConfigError(f"{text!r}", where=f"environment variable {name}", allowed=allowed)


def _met(call: Callable[[], Any]) -> Any:
    """As `_reached`, for calls that wait for ranks that may not even have been started, and hear no signal meanwhile.

    A thread makes the call, so that an interruption ends this process at once.
    """
    done: queue.SimpleQueue[tuple[Any, BaseException | None]] = queue.SimpleQueue()

    def work() -> None:
        try:
            done.put((call(), None))
        except BaseException as error:
            # raised where it was asked for
            done.put((None, error))

    def result() -> Any:
        threading.Thread(target=work, daemon=True).start()
        value, error = done.get()
        if error is not None:
            raise error
        return value

    return _reached(result)


def _reached(call: Callable[[], Any]) -> Any:
    """The result of a call that waits for other ranks.

    Raises:
        LostRankError: One of them ended, or does not answer.
    """
    try:
        return call()
    except (RuntimeError, ConnectionError, TimeoutError) as error:
        # gloo's first sentence, without the place in its source
        reason = re.sub(r"^\[[^]]*\] ", "", str(error)).split(". ")[0].partition("\n")[0]
        raise LostRankError(
            f"another rank ended or does not answer ({reason})",
            where="torchrun",
            hint="look at that rank's own message",
        ) from None


@dataclass(frozen=True)
class ConnectedRanks(Ranks):
    """One of several ranks.

    Arguments:
        store: Where ranks leave notes that outlive them.
    """

    store: Any = None

    def gather(self, rows: Rows, *, of: int | None = None) -> Rows:
        """See `Ranks`."""
        counts = None if of is None else [len(range(of)[self.rows_of(of, rank)]) for rank in range(self.size)]
        if isinstance(rows, np.ndarray):
            return self._gathered(torch.tensor(np.ascontiguousarray(rows)), counts)[0].numpy()
        return self._gathered(rows, counts)[0]

    def gathered(self, rows: np.ndarray) -> tuple[np.ndarray, slice]:
        """See `Ranks`."""
        every, mine = self._gathered(torch.tensor(np.ascontiguousarray(rows)))
        return every.numpy(), mine

    def _counts(self, own: int) -> list[int]:
        counts = torch.zeros(self.size, dtype=torch.int64)
        counts[self.rank] = own
        _reached(lambda: distributed.all_reduce(counts))
        return counts.tolist()

    def _gathered(self, rows: Tensor, counts: list[int] | None = None) -> tuple[Tensor, slice]:
        counts, rows = counts or self._counts(len(rows)), rows.detach()
        longest = max(counts)
        padded = rows.new_zeros(longest, *rows.shape[1:])
        padded[: len(rows)] = rows
        found = [torch.empty_like(padded) for _ in range(self.size)]
        _reached(lambda: distributed.all_gather(found, padded))
        every = torch.cat([part[:count] for part, count in zip(found, counts, strict=True)])
        start = sum(counts[: self.rank])
        return every, slice(start, start + len(rows))

    def _reduced(self, values: np.ndarray, operation: Any) -> np.ndarray:
        # one type on all ranks, also where numpy found nothing to add up and made it an integer
        total = torch.tensor(values, dtype=torch.float64)
        _reached(lambda: distributed.all_reduce(total, operation))
        return total.numpy()

    def sum(self, values: np.ndarray) -> np.ndarray:
        """See `Ranks`."""
        return self._reduced(values, distributed.ReduceOp.SUM)

    def max(self, values: np.ndarray) -> np.ndarray:
        """See `Ranks`."""
        return self._reduced(values, distributed.ReduceOp.MAX)

    def share(self, content: bytes) -> bytes:
        """See `Ranks`."""
        length = torch.tensor([len(content)])
        _reached(lambda: distributed.broadcast(length, 0))
        sent = np.frombuffer(content, dtype=np.uint8) if self.first else np.zeros(int(length), dtype=np.uint8)
        values = torch.tensor(sent)
        _reached(lambda: distributed.broadcast(values, 0))
        return values.numpy().tobytes()

    def sum_gradients(self, parameters: Iterable[torch.nn.Parameter], *, valid: bool) -> None:
        """See `Ranks`."""
        parameters = list(parameters)
        parts = [p.grad if p.grad is not None else torch.zeros_like(p) for p in parameters]
        total = torch.cat([part.detach().reshape(-1) for part in parts])
        if not valid:
            total.fill_(torch.nan)
        _reached(lambda: distributed.all_reduce(total))
        start = 0
        for parameter in parameters:
            parameter.grad = total[start : start + parameter.numel()].view_as(parameter)
            start += parameter.numel()

    def tell(self) -> None:
        """See `Ranks`."""
        with contextlib.suppress(RuntimeError):  # whoever kept the notes is gone, too
            self.store.set(TOLD, b"1")

    def is_told(self) -> bool:
        """See `Ranks`."""
        with contextlib.suppress(RuntimeError):
            self.store.wait([TOLD], TOLD_WITHIN)
            return True
        return False

    def leave(self) -> None:
        """See `Ranks`."""
        _reached(distributed.barrier)
        distributed.destroy_process_group()


# Named in the errors of a rank that has no folder.
NO_FOLDER = Path("the first rank's run")


def finish(ranks: Ranks) -> None:
    """Tell the others that nothing more comes, and part from them."""
    if ranks.size > 1:
        ranks.share(b"")
        ranks.leave()


def follow(ranks: Ranks) -> None:
    """Learn along with the first rank; writes and prints nothing."""
    ground: Ground | None = None
    while content := ranks.share(b""):
        job = json.loads(content)
        task, config = config_of(Document(job["config"], "the first rank's configuration"))
        if job["job"] == "ground":
            ground = prepare_ground(task, config, ranks)
        else:
            learn(
                task, config, NO_FOLDER, resume=job["resume"], device=job["device"], ground=ground, ranks=ranks
            )
    ranks.leave()
