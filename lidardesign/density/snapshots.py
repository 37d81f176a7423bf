"""The flow as it was at a few steps of learning, kept in the run: what more steps bought can then be measured.

Snapshots lie where the target is the final one: when balancing begins, and at a quarter and half of it. Before that,
steps sharpen the target instead of reducing an error. Within it the error jitters from step to step while steps are
long, so those two have a twin shortly before: how far twins are apart tells by how much. After the last step the flow
itself is there.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from lidardesign.density.flow import DesignFlow
from lidardesign.density.settings import LearningSettings
from lidardesign.run.checkpoint import save_arrays
from lidardesign.run.files import remove_stray_temporaries
from lidardesign.run.manifest import forget, read_manifest

FOLDER = "snapshots"
# Of the last phase. Error falls by a power of the steps: doublings show it best.
SHARES = (0.0, 1 / 4, 1 / 2)
# Twins lie this share of the last phase apart: far enough for the flow to have moved, too near to have learned much.
TWIN_SHARE = 1 / 32
_NAME = re.compile(rf"{FOLDER}/step-(\d+)\.safetensors")


def last_phase_begins(settings: LearningSettings) -> int:
    """The step from which on the target is the final one."""
    pathwise = round((1 - settings.balance) * settings.steps)
    return pathwise if settings.balance else math.ceil(settings.anneal * pathwise)


def rung_steps(settings: LearningSettings) -> tuple[int, ...]:
    """The steps that a training is judged after, ascending; the last one is its end."""
    first, steps = last_phase_begins(settings), settings.steps
    return tuple(sorted({*(first + int(share * (steps - first)) for share in SHARES), steps} - {0}))


def twin_step(settings: LearningSettings, step: int) -> int | None:
    """The step of a rung's twin; None for the first rung, the last one, and where there is no room for one."""
    twin = step - max(round(TWIN_SHARE * (settings.steps - last_phase_begins(settings))), 1)
    before = max((rung for rung in rung_steps(settings) if rung < step), default=step)
    return twin if before < twin and step < settings.steps else None


def snapshot_steps(settings: LearningSettings) -> tuple[int, ...]:
    """The steps after which a snapshot is kept, ascending."""
    rungs = [step for step in rung_steps(settings) if step < settings.steps]
    twins = (twin_step(settings, step) for step in rungs)
    return tuple(sorted({*rungs, *(twin for twin in twins if twin is not None)}))


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
