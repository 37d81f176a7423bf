"""How a design is fitted, its rays chosen on scenes where that is asked for, and checked before anyone sees it.

Where nobody says how many sensors it has, designs of a few and of more are fitted alike, at the middle number of rays
and in the bandwidth of those of most sensors. The task scores them on training scenes that were held back; the fewest
sensors win that are no worse than the best by more than a standard error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from lidardesign.constraints.check import ConstraintCheck, check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.errors import BackgroundNote, DataError, InfeasibleError
from lidardesign.fitting import request as fit_choices
from lidardesign.fitting.request import BEST, FitRequest
from lidardesign.fitting.run_samples import KEY, RunTarget
from lidardesign.layouts.rays import LAYOUTS
from lidardesign.layouts.track import travelled
from lidardesign.mixture.fit import FitResult, rays_at
from lidardesign.mixture.fit import fit as fit_samples
from lidardesign.mixture.quantise import SAMPLES_PER_RAY
from lidardesign.mixture.support import LEAST_SAMPLES, MOVED_SAMPLES, at_condition, condition_text
from lidardesign.rays import information
from lidardesign.rays.information import checked_information
from lidardesign.registry import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.run.manifest import versions
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.run_folder import Notes, ignore, log_note, relative_folder
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.scene import Scene, group_numbers
from lidardesign.scoring.baselines.candidates import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.sensor import DesignSpec
from lidardesign.task import mount_of, random_generator


class Fitter:
    """Fits the designs of requests that differ in choices and constraints, to samples weighted by settings of the task.

    Raises:
        ConfigError: A setting that cannot be, or a name that is not a condition of the density.
        DataError: The density is too rough, with or without the settings.
    """

    def __init__(self, request: FitRequest, notes: Notes = log_note, progress: Notes = ignore) -> None:
        self.run, self.seed, self.notes, self.progress = request.run, request.seed, notes, progress
        self.target = RunTarget(request.run, weighting=request.weighting)
        request.run.config.space.at(request.at)
        with phase("samples"):
            self.samples = load_samples(request.run.folder, request.run.config.space)
            self._check_effective_samples("learn longer (--preset standard or fine), or with a larger density.sigma_m")
            if request.weighting.settings:
                before = self.samples.effective_sample_size
                self.samples = self.samples.retargeted(self.target(self.samples.points))
                self._check_effective_samples("choose a setting nearer to the learned one, or learn with it")
                now, settings = self.samples.effective_sample_size, ", ".join(request.weighting.settings)
                notes(BackgroundNote(f"with {settings} the samples have ESS {now:.2f}, and {before:.2f} as learned"))

    def _check_effective_samples(self, hint: str) -> None:
        """Refuse samples of which too few are effective to fit anything to, whatever the constraints."""
        effective = self.samples.independent
        if effective < LEAST_SAMPLES:
            raise DataError(
                f"the density is too rough: its {len(self.samples)} samples count as only {effective:.0f}",
                where=str(self.run.folder),
                allowed=f"at least {LEAST_SAMPLES}",
                hint=hint,
            )

    @cached_property
    def first_scenes(self) -> dict[str, list[Scene]]:
        """The first scenes that are chosen on, and that are held back, by purpose; what is found of them stays."""
        from lidardesign.fitting.select_rays import selection_scenes

        return {
            purpose: list(islice(selection_scenes(self.run, self.seed, purpose), information.FEW_SCENES))
            for purpose in ("choice", "held back")
        }

    @phase("fitting")
    def fit(self, request: FitRequest, samples: Samples | None = None, **choices: Any) -> FitResult:
        """The design, by the request's choices and these instead of some of them, to other samples if there are."""
        samples = self.samples if samples is None else samples
        if request.at:
            count = max(MOVED_SAMPLES, SAMPLES_PER_RAY * (request.choices.get("rays") or 0))
            samples = at_condition(samples, request.at, self.target, count, random_generator(request.seed, "condition"))
            place, ess = condition_text(request.at), samples.effective_sample_size
            self.notes(BackgroundNote(f"at {place} {len(samples)} samples have ESS {ess:.2f}"))
        return fit_samples(
            samples,
            constraints=request.constraints,
            seed=request.seed,
            name=request.name,
            retarget=self.target,
            **{**request.choices, **choices},
        )


def fit_design(request: FitRequest, *, notes: Notes = log_note, progress: Notes = ignore) -> FitResult:
    """Fit the design of a request and check it; nothing is written.

    Arguments:
        request: What is asked for.
        notes: Called with every note.
        progress: Called with every step, as "choosing 361 rays".

    Returns:
        The fit, whose design says where it came from and whose checks are of the design's own text.

    Raises:
        ConfigError: Choices that do not fit together.
        DataError: The density is too rough.
        InfeasibleError: Constraints that contradict each other, or that the design does not keep.
    """
    run, weighting, fitter = request.run, request.weighting, Fitter(request, notes, progress)
    if request.choices["sensors"] == BEST:
        count = _best_count(fitter, request)
        request = replace(request, choices={**request.choices, "sensors": count})
    result = _fitted(fitter, request)
    for note in result.notes:
        notes(note)
    design, further = result.design, {KEY: weighting.as_document()} if weighting.settings else {}
    if len(request.names) == len(design.sensors):
        named = (replace(sensor, name=name) for sensor, name in zip(design.sensors, request.names, strict=True))
        design = replace(design, sensors=tuple(named))
    origin = {
        "command": request.command,
        "task": run.task.name,
        "run": relative_folder(run.folder, run.design_path(request.name)),
        "seed": request.seed,
        "versions": versions(),
    }
    with plugin_guard(run.task.name):
        mount = mount_of(run.task, run.config.task)
    design = replace(design, mount=mount, provenance={**design.provenance, **origin, **further})
    with phase("writing"):
        checks = check_written(design, request)
    for note in _silent_notes(fitter, request, design):
        notes(note)
    # broken ones were refused
    return replace(result, design=design, constraints=checks, satisfied=True)


def _silent_notes(fitter: Fitter, request: FitRequest, design: DesignSpec) -> list[str]:
    """Whether the most rays of a design have hardly a return from scenes that the fit has made anyway."""
    run, count = request.run, request.choices["rays"] or max(request.run.task.defaults.rays)
    scenes = vars(fitter).get("first_scenes", {}).get("held back")
    if not scenes:
        return []
    from lidardesign.scoring.evaluation.request import numbers_fired
    from lidardesign.scoring.scenes.scene_scores import silent_notes

    if not numbers_fired(design, [count]):
        return []
    conditions = [request.at] if request.at else run.conditions()
    fired = tuple(rays_at(design, count, fitter.samples, at=at or None) for at in conditions)
    return silent_notes(scenes, {f"{design.name!r}": fired})


def _best_count(fitter: Fitter, request: FitRequest) -> int:
    """The number of sensors that scores best on training scenes; says what was tried."""
    if request.constraints is not None:
        check_feasible(request.constraints, request.run.config.space, rays=request.choices["rays"])
    scenes, metric = fitter.first_scenes["held back"], request.run.metric

    def fit(trial: FitRequest) -> FitResult:
        fitter.progress(f"trying {trial.choices['sensors']} sensors")
        return _fitted(fitter, trial, is_trial=True)

    trials = trials_of(request, fitter.samples, scenes, fit)
    best = best_of(trials, scenes)
    sign = 1.0 if metric.better == "lower" else -1.0
    found = ", ".join(f"{trial.sensors}: {sign * trial.scores.mean():.4g}" for trial in trials)
    text = f"sensors: {best.sensors}; {metric.name} [{metric.unit}] on {len(scenes)} training scenes "
    fitter.notes(BackgroundNote(f"{text}in {trials[-1].mbps:.3g} Mbit/s by their number: {found}"))
    return best.sensors


class Trial(NamedTuple):
    """A design of some number of sensors: its score on each scene, turned so that lower is better, and its bits."""

    sensors: int
    scores: np.ndarray
    mbps: float


@phase("trials")
def trials_of(
    request: FitRequest, samples: Samples, scenes: Sequence[Scene], fit: Callable[[FitRequest], FitResult]
) -> list[Trial]:
    """Designs of few sensors and of more, in the bandwidth of those of most: the gates of many fit best.

    Arguments:
        request: What is asked for, but for the number of sensors.
        samples: What layouts follow from.
        scenes: Training scenes that designs are not fitted to.
        fit: Fits the design of a request.

    Raises:
        InfeasibleError: No number of sensors keeps the constraints; says why the fewest do not.
    """
    from lidardesign.scoring.scenes.scene_scores import score_lists
    from lidardesign.simulate.returns import build_casters

    run, constraints = request.run, request.constraints or Constraints()
    budgets = sorted(run.task.defaults.rays)
    rays = request.choices["rays"] or budgets[len(budgets) // 2]
    conditions = [request.at] if request.at else run.conditions()
    casters = [build_casters(scene) for scene in scenes]
    sign = 1.0 if run.metric.better == "lower" else -1.0
    low = max(constraints.sensors.min or 1, len(constraints.each))
    high = constraints.sensors.max or math.inf
    trials: list[Trial] = []
    refused = None
    for count in reversed([count for count in fit_choices.COUNTS if low <= count <= high] or [low]):
        limited = _within(request.constraints, trials[0].mbps) if trials else request.constraints
        choices = {**request.choices, "sensors": count, "rays": rays}
        try:
            design = fit(replace(request, choices=choices, constraints=limited)).design
        except InfeasibleError as error:
            refused = error
            continue
        fired = tuple(rays_at(design, rays, samples, at=at or None) for at in conditions)
        scores = [
            next(score_lists(run.task, run.metric, scene, [fired], caster))[0].value
            for scene, caster in zip(scenes, casters, strict=True)
        ]
        trials.append(Trial(count, sign * np.array(scores), mean_mbps(fired, Bandwidth())))
    if not trials and refused is not None:
        raise refused
    return trials[::-1]


def best_of(trials: Sequence[Trial], scenes: Sequence[Scene]) -> Trial:
    """The fewest sensors that are no worse than the best by more than the standard error of the difference."""
    best = min(trials, key=lambda trial: trial.scores.mean())
    groups = group_numbers(scenes)
    for trial in trials:
        lost = np.bincount(groups, trial.scores - best.scores) / np.bincount(groups)
        error = lost.std(ddof=1) / math.sqrt(len(lost)) if len(lost) > 1 else 0.0
        if lost.mean() <= error:
            return trial
    return best


def _within(constraints: Constraints | None, mbps: float) -> Constraints:
    """Constraints with a bandwidth, where they have none."""
    document: dict[str, Any] = {} if constraints is None else dict(constraints.as_document())
    budget = document.get("budget") or {}
    return Constraints.from_mapping({**document, "budget": {"bandwidth_mbps": mbps, **budget}})


def _fitted(fitter: Fitter, request: FitRequest, *, is_trial: bool = False) -> FitResult:
    """The design of a request; in layouts whose rays are chosen, for each number of rays.

    Arguments:
        fitter: Fits sensors.
        request: What is asked for.
        is_trial: Whether rays are chosen on the first scenes alone, without certificates.
    """
    samples, run = fitter.samples, request.run
    layout, rays = request.choices["layout"], request.choices["rays"]
    constraints = request.constraints or Constraints()
    if constraints.parts is None and not LAYOUTS[layout].chosen_on_scenes:
        return fitter.fit(request)
    from lidardesign.fitting.select_rays import near, select_rays, selection_scenes

    fit_choices.check_chosen(run.task, layout)
    informs, scenes = partial(checked_information, run.task), partial(selection_scenes, run, request.seed)
    if constraints.parts is not None:
        from lidardesign.fitting.part_design import choose_parts

        return choose_parts(
            samples,
            constraints,
            count=request.choices["sensors"],
            rays=rays,
            informs=informs,
            scenes=scenes,
            seed=request.seed,
            name=request.name,
            notes=fitter.notes,
            progress=fitter.progress,
        )
    if layout == "spinning":
        from lidardesign.fitting.spinning import CHANNELS, choose_rings

        return choose_rings(
            samples,
            constraints,
            count=request.choices["sensors"] or 1,
            channels=CHANNELS if request.channels is None else request.channels,
            rays=rays,
            informs=informs,
            scenes=scenes,
            name=request.name,
        )
    counts = sorted({request.choices["rays"]} if request.choices["rays"] else set(request.run.task.defaults.rays))
    if samples.space.conditioned:
        travelled(samples.space, "selected")
    # the rays of a track have gates of their own, as those of a scan
    gates = request.choices["gates"] or ("ray" if samples.space.conditioned else LAYOUTS["selected"].usual_gates)
    (place, *_) = request.run.conditions(samples.space)
    # the gates of chosen rays keep a bandwidth; a sensor that moves along a condition looks everywhere the same way
    fitted = fitter.fit(request, near(samples, place, 1.0), layout="density", rays=counts[-1], gates="ray")
    fitted = replace(fitted, design=replace(fitted.design, gates=gates))
    progress = ignore if is_trial else fitter.progress
    return select_rays(
        run, fitted, counts, samples, request.seed, fitter.first_scenes, is_trial=is_trial, progress=progress
    )


def check_written(design: DesignSpec, request: FitRequest) -> list[ConstraintCheck]:
    """Check a design's own text against its constraints with code that the fit does not share.

    Raises:
        InfeasibleError: A constraint does not hold.
    """
    if request.constraints is None:
        return []
    written = parse_yaml(dump_yaml(design_document(design)), where=design.name).value
    checks = list(check_design(written, request.constraints, request.run.config.space))
    broken = [check for check in checks if not check.satisfied]
    if broken:
        first = broken[0]
        raise InfeasibleError(
            f"the best design found breaks {first.name}: {first.value}, bound {first.bound}",
            conflicts=[check.name for check in broken],
            hint="loosen one of the constraints; no file was written",
        )
    return checks
