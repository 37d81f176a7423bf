"""What a checkpoint must hold to be resumed: counters, the optimiser's memory of every weight, the random stream."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidardesign.errors import DataError

COUNTERS = ("step", "skipped", "skipped_in_a_row", "halvings")
# A step size is divided by 2 to this power.
MOST_HALVINGS, MOST_STEPS, MOST_SECONDS = 64, 10**12, 1e12
MOMENTS = ("exp_avg", "exp_avg_sq")
HINT = "resume with the run's own configuration, or learn the run again"


def check_resumable(
    arrays: Mapping[str, np.ndarray],
    state: Mapping[str, Any],
    flow: torch.nn.Module,
    generator: torch.Generator,
    path: Path,
) -> None:
    """Refuse a checkpoint that is whole, but of which training cannot go on.

    Arguments:
        arrays, state: Its content.
        flow: The flow whose weights it should have.
        generator: The random stream whose state it should have.
        path: The file.

    Raises:
        DataError: A counter or an array is missing, or is none.
    """
    for name in (*COUNTERS, "doubled_at"):
        value = state.get(name)
        most = MOST_HALVINGS if name == "halvings" else MOST_STEPS
        whole = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= most
        if not whole and not (name == "doubled_at" and value is None):
            raise DataError(f"has {name} = {value!r}", where=str(path), allowed="a whole number", hint=HINT)
    seconds = state.get("seconds")
    if not isinstance(seconds, int | float) or isinstance(seconds, bool) or not 0 <= seconds <= MOST_SECONDS:
        raise DataError(f"has seconds = {seconds!r}", where=str(path), allowed="a number from 0", hint=HINT)
    weights = {f"flow.{name}": value.numel() for name, value in flow.state_dict().items()}
    held = {name: array.size for name, array in arrays.items() if name.startswith("flow.")}
    if held != weights:
        differing = sorted(name for name in {*held, *weights} if held.get(name) != weights.get(name))
        raise DataError(f"the checkpoint is of another flow: {differing[0]} differs", where=str(path), hint=HINT)
    for index, parameter in enumerate(flow.parameters()):
        start = f"adam.{index}."
        found = {name: array for name, array in arrays.items() if name.startswith(start)}
        # the file keeps a single number as a list of one
        expected = {f"{start}{name}": tuple(parameter.shape) for name in MOMENTS} | {f"{start}step": (1,)}
        # a weight that no step has moved yet has no moments
        if found and {name: array.shape for name, array in found.items()} != expected:
            raise DataError(f"the checkpoint is of another flow: {start[:-1]} differs", where=str(path), hint=HINT)
        if any(array.dtype.kind != "f" for array in found.values()):
            raise DataError(f"holds no numbers in {start[:-1]}", where=str(path), hint=HINT)
        # squares are not negative, and who has moments has taken a step: the optimiser takes roots and divides
        if found and (found[f"{start}exp_avg_sq"].min() < 0 or found[f"{start}step"].min() < 1):
            raise DataError(f"holds impossible numbers in {start[:-1]}", where=str(path), hint=HINT)
    stream, own = arrays.get("generator"), generator.get_state()
    if stream is None or stream.dtype != np.uint8 or stream.shape != tuple(own.shape):
        raise DataError("holds no random stream", where=str(path), hint=HINT)
    try:
        torch.Generator().set_state(torch.as_tensor(stream.copy()))
    except RuntimeError as error:
        raise DataError(f"holds a damaged random stream ({error})", where=str(path), hint=HINT) from None
