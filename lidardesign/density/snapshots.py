"""The flow as it was at a few steps of learning, kept in the run: what more steps bought can then be measured.

Snapshots lie where the target is the final one: when balancing begins, and at an eighth, a quarter and half of it.
Before that, steps sharpen the target instead of reducing an error. After the last step the flow itself is there.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lidardesign.density.flow import DesignFlow
from lidardesign.run.checkpoint import save_arrays
from lidardesign.run.files import remove_stray_temporaries
from lidardesign.run.manifest import forget, read_manifest

FOLDER = "snapshots"
# The error falls by a power of the steps: doublings show it best, and three are enough to see it.
SHARES = (0.0, 1 / 8, 1 / 4, 1 / 2)
_NAME = re.compile(rf"{FOLDER}/step-(\d+)\.safetensors")


def snapshot_steps(first: int, steps: int) -> tuple[int, ...]:
    """The steps after which a snapshot is kept, ascending, where the last phase begins after `first` of the steps."""
    return tuple(sorted({first + int(share * (steps - first)) for share in SHARES} - {0, steps}))


def snapshot_name(step: int) -> str:
    """The file of a step, relative to the run."""
    return f"{FOLDER}/step-{step:06d}.safetensors"


def save_snapshot(flow: DesignFlow, run: Path, step: int) -> None:
    """Keep the flow's weights after a step; no clock enters, so that a resumed run writes the same bytes."""
    weights: dict[str, np.ndarray] = {key: value.detach().cpu().numpy() for key, value in flow.state_dict().items()}
    save_arrays(run, snapshot_name(step), weights, {"step": step, "features": flow.features, "context": flow.context})


def kept_snapshots(run: Path) -> dict[int, str]:
    """The run's snapshots, step to file, ascending; empty for a run that kept none."""
    found = (_NAME.fullmatch(name) for name in read_manifest(run)["files"])
    return dict(sorted((int(match[1]), match[0]) for match in found if match))


def clear_snapshots(run: Path, *, beyond: int = 0) -> None:
    """Remove the snapshots after a step, and what a killed process left of one."""
    folder = Path(run) / FOLDER
    if not folder.is_dir():
        return
    remove_stray_temporaries(folder)
    forget(run, [name for step, name in kept_snapshots(run).items() if step > beyond])
