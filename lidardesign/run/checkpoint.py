"""Checkpoints of learning: every array and counter that a bit-identical resume needs, in one safetensors file.

safetensors runs no code and refuses truncated files; the hash in the manifest catches flipped bits and `load` checks
that values are finite.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import DataError
from lidardesign.run.manifest import verify, write_recorded

FORMAT = "lidardesign-1"


def save_arrays(run: Path, name: str, arrays: Mapping[str, np.ndarray], state: Mapping[str, Any]) -> None:
    """Write arrays and plain state atomically, with their hash in the manifest at every moment."""
    from safetensors.numpy import save

    # one entry only: safetensors writes several in an order that changes from process to process
    metadata = {FORMAT: json.dumps(dict(state))}
    write_recorded(run, name, save({key: np.ascontiguousarray(value) for key, value in arrays.items()}, metadata))


def load_arrays(run: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and state of a checkpoint.

    Raises:
        DataError: The file is missing, damaged, not ours, or holds values that are not finite.
    """
    from safetensors import SafetensorError, safe_open

    verify(run, name)
    path = run / name
    try:
        with safe_open(path, framework="np") as file:
            metadata = file.metadata() or {}
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a mapping
    except (SafetensorError, OSError) as error:
        raise DataError(f"cannot be read: {error}", where=str(path), hint="learn the run again") from None
    if FORMAT not in metadata:
        found = ", ".join(sorted(metadata)) or "none"
        newer = found.startswith(FORMAT.rstrip("0123456789"))
        hint = "use the version of lidardesign that wrote it, or a newer one" if newer else "learn the run again"
        raise DataError(f"has the format {found!r}", where=str(path), allowed=FORMAT, hint=hint)
    for key, value in arrays.items():
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise DataError(f"{key} holds values that are not finite", where=str(path), hint="learn the run again")
    return arrays, _state_of(metadata[FORMAT], path)


def _state_of(text: str, path: Path) -> dict[str, Any]:
    try:
        state = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"its state cannot be read: {error}", where=str(path), hint="learn the run again") from None
    if not isinstance(state, dict):
        raise DataError("holds no state", where=str(path), hint="learn the run again")
    return state
