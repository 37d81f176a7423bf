"""What accuracy costs in time: sweeps over the settings of every numerical choice, for a task and a run, here."""

from __future__ import annotations

import time

from lidardesign.run.clock import Progress, phase
from lidardesign.scoring.accuracy import evaluation, fields, training, visibility
from lidardesign.scoring.accuracy.probes import AccuracyRequest
from lidardesign.scoring.sweep import Accuracy, Sweep

# In the order of the pipeline: the phase, its name for progress, and what gives the sweeps, none where the choice does
# not arise.
SWEEPS = (
    ("visibility", "visibility", visibility.sweeps),
    ("fields", "distance fields", fields.sweeps),
    ("precision", "arithmetic", training.dtype_sweeps),
    ("scenes", "scenes per step", training.frames_sweeps),
    ("training", "training", training.steps_sweeps),
    ("physics", "effects of light", evaluation.physics_sweeps),
    ("held_out", "held-out scenes", evaluation.scenes_sweeps),
)


def measure_accuracy(request: AccuracyRequest, progress: Progress | None = None) -> Accuracy:
    """Measure every sweep that applies.

    Arguments:
        request: What to measure on.
        progress: Called with the label of the next kind of sweeps, the kinds done, and all kinds.
    """
    measured: list[Sweep] = []
    seconds: dict[str, float] = {}
    for done, (name, label, sweeps) in enumerate(SWEEPS):
        if progress:
            progress(label, done, len(SWEEPS))
        started = time.perf_counter()
        with phase(name):
            measured += sweeps(request)
        seconds[name] = round(time.perf_counter() - started, 3)
    if progress:
        progress("", len(SWEEPS), len(SWEEPS))
    return Accuracy(measured, seconds)
