"""Checkpoints and snapshots of learning: arrays and counters in safetensors files, refused where they are damaged.

A checkpoint holds every array and counter that a bit-identical resume needs: counters, the optimiser's memory of every
weight, the random stream. safetensors runs no code and refuses truncated files; the hash in the manifest catches
flipped bits and `load_arrays` checks that values are finite.

Snapshots are the averaged flow as it was when balancing began and after each doubling of the steps from there: what
more steps bought can then be measured.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import UnionType
from typing import Any

import numpy as np
import torch

from lidardesign.config import LearningSettings
from lidardesign.density.network import DesignFlow
from lidardesign.errors import DataError
from lidardesign.run.inputs import STATE, check_file, parse_json
from lidardesign.run.manifest import forget, read_manifest, verify, write_recorded

# 2: one network for each dimension of the flow; files of version 1 had one for each spline.
FORMAT = "lidardesign-2"


def save_arrays(run: Path, name: str, arrays: Mapping[str, np.ndarray], state: Mapping[str, Any]) -> None:
    """Write arrays and plain state atomically, with their hash in the manifest at every moment."""
    from safetensors.numpy import save

    contiguous = {key: np.ascontiguousarray(value) for key, value in arrays.items()}
    # one entry only: safetensors writes several in an order that changes from process to process
    write_recorded(run, name, save(contiguous, {FORMAT: json.dumps(dict(state))}))


def load_arrays(run: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and state of a checkpoint.

    Raises:
        DataError: The file is missing, damaged, not ours, or holds values that are not finite.
    """
    from safetensors import SafetensorError, safe_open

    verify(run, name)
    path = run / name
    check_file(path, STATE)
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError) as error:
        raise DataError(f"cannot be read: {error}", where=str(path), hint="learn the run again") from None
    if FORMAT not in metadata:
        found = ", ".join(sorted(metadata)) or "none"
        ours = found.startswith(FORMAT.rstrip("0123456789"))
        hint = "learn the run again" + (", or use the version of lidardesign that wrote it" if ours else "")
        raise DataError(f"has the format {found!r}", where=str(path), allowed=FORMAT, hint=hint)
    for key, value in arrays.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise DataError(f"{key} holds values that are not finite", where=str(path), hint="learn the run again")
    try:
        state = parse_json(metadata[FORMAT])
    except ValueError as error:
        raise DataError(f"its state cannot be read: {error}", where=str(path), hint="learn the run again") from None
    if not isinstance(state, dict):
        raise DataError("holds no state", where=str(path), hint="learn the run again")
    return arrays, state


# The flow that steps move, the average of where it was, and the best of these averages that was measured.
FLOWS = ("flow", "average", "best")
COUNTERS = ("step", "skipped", "skipped_in_a_row", "halvings")
# A step size is divided by 2 to this power.
MOST_HALVINGS, MOST_STEPS, MOST_SECONDS = 64, 10**12, 1e12
MOMENTS = ("exp_avg", "exp_avg_sq")
HINT = "resume with the run's own configuration, or learn the run again"


def _is_number(value: Any, most: float, kinds: type | UnionType = int | float) -> bool:
    return isinstance(value, kinds) and not isinstance(value, bool) and 0 <= value <= most


def _is_count(value: Any) -> bool:
    return _is_number(value, MOST_STEPS, int)


# What every entry of a state has to be, in words, and whether a value is that.
ENTRIES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    **dict.fromkeys(COUNTERS, ("a whole number", _is_count)),
    "halvings": ("a whole number", lambda value: _is_number(value, MOST_HALVINGS, int)),
    "doubled_at": ("a whole number", lambda value: value is None or _is_count(value)),
    "least_misplaced": ("a share from 0 to 1", lambda value: value is None or _is_number(value, 1)),
    "stopped": ("true or false", lambda value: isinstance(value, bool)),
    "seconds": ("a number from 0", lambda value: _is_number(value, MOST_SECONDS)),
}


def check_resumable(
    arrays: Mapping[str, np.ndarray], state: Mapping[str, Any], flow: torch.nn.Module, path: Path
) -> None:
    """Refuse a checkpoint that training cannot resume from, although its file is whole.

    Arguments:
        arrays, state: Its content.
        flow: The flow whose weights it should have.
        path: The file.

    Raises:
        DataError: A counter or an array is missing, or is none.
    """
    for name, (allowed, fits) in ENTRIES.items():
        if not fits(state.get(name)):
            raise DataError(f"has {name} = {state.get(name)!r}", where=str(path), allowed=allowed, hint=HINT)
    weights = {f"{of}.{name}": tuple(value.shape) for of in FLOWS for name, value in flow.state_dict().items()}
    held = {name: array.shape for name, array in arrays.items() if name.partition(".")[0] in FLOWS}
    if held != weights:
        differing = sorted(name for name in {*held, *weights} if held.get(name) != weights.get(name))
        raise DataError(f"the checkpoint belongs to another flow: {differing[0]} differs", where=str(path), hint=HINT)
    for index, parameter in enumerate(flow.parameters()):
        start = f"adam.{index}."
        found = {name: array for name, array in arrays.items() if name.startswith(start)}
        # the file keeps a single number as a list of one
        expected = {f"{start}{name}": tuple(parameter.shape) for name in MOMENTS} | {f"{start}step": (1,)}
        # a weight that no step has moved yet has no moments
        if found and {name: array.shape for name, array in found.items()} != expected:
            raise DataError(f"the checkpoint belongs to another flow: {start[:-1]} differs", where=str(path), hint=HINT)
        # the optimiser takes roots of squares and divides by steps: no negative squares, no moments without a step
        if found and (found[f"{start}exp_avg_sq"].min() < 0 or found[f"{start}step"].min() < 1):
            raise DataError(f"holds impossible numbers in {start[:-1]}", where=str(path), hint=HINT)
    try:
        torch.Generator().set_state(torch.as_tensor(arrays["generator"].copy()))
    except (KeyError, TypeError, RuntimeError) as error:
        raise DataError(f"holds no random stream ({error})", where=str(path), hint=HINT) from None


FOLDER = "snapshots"
_NAME = re.compile(rf"{FOLDER}/step-(\d+)\.safetensors")


def is_snapshot(step: int, settings: LearningSettings) -> bool:
    """True after the steps whose flow is kept: each doubling, since errors fall by a power of the steps."""
    doublings, rest = divmod(step, max(settings.pathwise_steps, 1))
    return rest == 0 and doublings.bit_count() == 1 and step < settings.steps


def snapshot_name(step: int) -> str:
    """The file of a step, relative to the run."""
    return f"{FOLDER}/step-{step:06d}.safetensors"


def save_flow(flow: DesignFlow, run: Path, name: str, **state: float) -> None:
    """Write the flow's weights; no clock enters, so that a resumed run writes the same bytes."""
    weights = {key: value.detach().cpu().numpy() for key, value in flow.state_dict().items()}
    save_arrays(run, name, weights, {**state, "features": flow.features, "context": flow.context})


def stored_snapshots(run: Path) -> dict[int, str]:
    """The run's snapshots, step to file, ascending; empty for a run that kept none."""
    found = (_NAME.fullmatch(name) for name in read_manifest(run)["files"])
    return dict(sorted((int(match[1]), match[0]) for match in found if match))


def clear_snapshots(run: Path, *, beyond: int = 0) -> None:
    """Remove the snapshots after a step."""
    forget(run, [name for step, name in stored_snapshots(run).items() if step > beyond])
