"""What learning costs: the misplaced share after a part of the steps, and with other presets."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lidardesign.config import PRESETS, RunConfig, load_run_config
from lidardesign.density.learn import FLOW
from lidardesign.density.learned import SnapshotQuality, load_flow, remeasured
from lidardesign.density.target.target import Target
from lidardesign.density.training.quality import IndependentProbes, draw_probes, measure
from lidardesign.design.fit import fit_like
from lidardesign.design.layouts.rays import layout_of
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import LidardesignError
from lidardesign.estimates import Estimate
from lidardesign.evaluate.accuracy.probes import ERROR_OF, AccuracyRequest
from lidardesign.evaluate.accuracy.settings import Measurement, Sweep
from lidardesign.evaluate.baselines.candidates import RaysPerCondition
from lidardesign.evaluate.scene_scores import score_lists
from lidardesign.registry import plugin_guard
from lidardesign.run.manifest import read_manifest, verify
from lidardesign.samples import Samples
from lidardesign.simulate.simulate import build_casters
from lidardesign.task import conditions_of, random_generator

# A misplaced share of a tenth is then known to 5 %.
SAMPLES = 8192
PROBES = 8192
TOLERANCE = 0.1
BECAUSE = (
    "a tenth of the rays in the wrong place is at worst a tenth fewer rays: 5 % of an error that falls like their root"
)
# A quick fit shows what a density's errors are worth in the metric; a careful one would take the sweep's time.
SCORED_SCENES = 8
RESTARTS = 2
STEPS_NOTE = "fewer steps are what this run had reached on its way; a run of that many does as well"


def sweeps(request: AccuracyRequest) -> Sequence[Sweep]:
    """The run's own snapshots, and runs of other presets beside it, where there are any."""
    seed, target = request.config.seed, request.target
    probes = draw_probes(target, PROBES, random_generator(seed, "accuracy", "training"))
    reached = remeasured(request.run, request.config, target, probes, count=SAMPLES, seed=seed)
    by_steps = _steps_sweep(request, reached)
    return [by_steps, *_preset_sweep(request, reached[-1], target, probes)]


def _steps_sweep(request: AccuracyRequest, reached: Sequence[SnapshotQuality]) -> Sweep:
    judge = _Judge(request, reached[-1].samples)
    scores = [judge.scores(one.samples) for one in reached]
    measurements = []
    for one, own in zip(reached, scores, strict=True):
        further, is_last = judge.values(own, scores[-1]), one is reached[-1]
        measurements.append(_measure(str(one.step), one.estimates, one.seconds, further, default=is_last))
    note = STEPS_NOTE if len(measurements) > 1 else "this run kept no snapshots; a run that is learned now does"
    return _sweep("learning.steps", "learning up to there", measurements, note + judge.note)


def _preset_sweep(
    request: AccuracyRequest, own: SnapshotQuality, target: Target, probes: IndependentProbes
) -> Sequence[Sweep]:
    """Runs of other presets against the same target, in the order of effort; empty where none lies beside this one."""
    config, own_seconds, measurements = request.config, _seconds(request.run), []
    for run, other in _presets(request):
        # what cannot be measured is left out: this run's figures do not depend on what lies beside it
        try:
            seconds, learned = _seconds(run), load_flow(run, FLOW, other, target, config.seed)
        except LidardesignError:
            continue
        if seconds is not None:
            estimates = measure(learned, probes, SAMPLES).estimates
            measurements.append(_measure(other.preset, estimates, seconds, {}, default=False))
    if not measurements or own_seconds is None:
        return []
    measurements.append(_measure(config.preset, own.estimates, own_seconds, {}, default=True))
    measurements.sort(key=lambda measurement: PRESETS.index(measurement.setting))
    note = "runs of the same task, space and density beside this one"
    return [_sweep("preset", "the whole of learn", measurements, note)]


def _presets(request: AccuracyRequest) -> list[tuple[Path, RunConfig]]:
    mine, found = request.config, {}
    for folder in sorted(request.run.absolute().parent.iterdir()):
        config = _config_of(folder)
        if config is None or config.preset in (mine.preset, *found):
            continue
        if (config.task_name, config.task, config.space, config.density) == (
            mine.task_name, mine.task, mine.space, mine.density
        ):  # fmt: skip
            found[config.preset] = (folder, config)
    return list(found.values())


def _config_of(folder: Path) -> RunConfig | None:
    """The configuration of a finished and sound run; None for anything else that lies there."""
    if not (folder / FLOW).is_file():
        return None
    try:
        verify(folder, FLOW)
        return load_run_config(folder)[1]
    except LidardesignError:
        return None


def _seconds(run: Path) -> float | None:
    """What the whole of learn took [s]; None where the manifest has no word of it."""
    seconds = (read_manifest(run).get("learn") or {}).get("seconds")
    return float(seconds) if isinstance(seconds, float | int) else None


def _measure(
    setting: str, estimates: Mapping[str, Estimate], seconds: float, further: Mapping[str, float], *, default: bool
) -> Measurement:
    misplaced = estimates["misplaced"]
    values = {name: estimates[name].value for name in ("ess", "kl_nats", "coverage")}
    errors = {f"{name}_error": estimates[name].error or 0.0 for name in values}
    return Measurement(
        setting,
        misplaced.value,
        misplaced.error or 0.0,
        seconds,
        default=default,
        values={**values, **errors, **further},
    )


def _sweep(knob: str, work: str, measurements: Sequence[Measurement], note: str) -> Sweep:
    return Sweep(knob, ERROR_OF, "", "the target density", TOLERANCE, BECAUSE, work, measurements, note)


class _Judge:
    """Scores quick fits, like the first of the run's designs that allows one, to samples of its flow at other times.

    Arguments:
        request: What is evaluated.
        samples: Of the flow as it is.
    """

    def __init__(self, request: AccuracyRequest, samples: Samples) -> None:
        asked = self._asked = request.request
        self._retarget = request.target.log_density
        self._rays = sorted(asked.rays)[len(asked.rays) // 2]
        with plugin_guard(asked.task.name):
            self._conditions = conditions_of(asked.task, asked.config, asked.space)
        allowing = (one for one in asked.designs if not one.at and self._laid_out(one, samples) is not None)
        self._design = next(allowing, None)
        self._scenes = [(scene, build_casters(scene)) for scene in asked.test[:SCORED_SCENES]] if self._design else []

    @property
    def note(self) -> str:
        """What the scores are of, to follow another note."""
        if self._design is None:
            return ""
        return f"; scores of quick fits like {self._design.name} with {self._rays} rays on {len(self._scenes)} scenes"

    def scores(self, samples: Samples) -> np.ndarray | None:
        """Per scene; None where the samples carry no such design."""
        positions = self._laid_out(self._design, samples) if self._design else None
        if positions is None:
            return None
        planner, scores = self._asked.planner, []
        for scene, casters in self._scenes:
            physics = planner.physics(planner.plan(scene, list(positions), casters), self._asked.seed)
            ((score, _),) = score_lists(self._asked.task, self._asked.metric, scene, [positions], casters, physics)
            scores.append(score.value)
        return np.array(scores)

    def values(self, scores: np.ndarray | None, last: np.ndarray | None) -> dict[str, float]:
        """The mean score, and its standard error beside the last measurement's, on the same scenes."""
        if scores is None or last is None:
            return {}
        apart, unit = scores - last, re.sub(r"\W+", "", self._asked.metric.unit)
        error = float(apart.std(ddof=1) / math.sqrt(len(apart))) if len(apart) > 1 else 0.0
        name = f"score_{unit}" if unit else "score"
        return {name: float(scores.mean()), f"{name}_difference_error": error}

    def _laid_out(self, design: DesignSpec, samples: Samples) -> RaysPerCondition | None:
        """The rays of a quick fit; None where its constraints fix other rays, or the samples are too few for it."""
        try:
            is_open = design.ray_table is None and layout_of(design).leaves_rays_open(design.gates)
            fitted = fit_like(
                design,
                samples,
                rays=None if is_open else self._rays,
                seed=self._asked.seed,
                restarts=RESTARTS,
                em_samples=4000,
                retarget=self._retarget,
            )
            return tuple(self._asked.lay_out(fitted, self._rays, samples, at=place) for place in self._conditions)
        except LidardesignError:
            return None
