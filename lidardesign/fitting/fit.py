"""One road from a density to a design: fit sensors, propose, inform, choose, certify; then check what is written.

Where the number of sensors is open, designs of several numbers are fitted at the middle number of rays and scored on
training scenes that were held back, each in the bandwidth that it takes. The fewest sensors within a standard error of
the best are taken, where bandwidth has the price that it has for rays. For a goal the least that keeps it is found in
the same way, and fitted again as if it had been asked for.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from shlex import join
from typing import TYPE_CHECKING

import numpy as np

from lidardesign.config import FILE_NAME, with_task_settings
from lidardesign.constraints.check import ConstraintCheck, check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.constraints.origins import placement_notes
from lidardesign.errors import BackgroundNote, DataError, InfeasibleError
from lidardesign.fitting.options import BEST
from lidardesign.fitting.request import COUNTS, KEY, WORLD, FitRequest, RunTarget, check_several
from lidardesign.fitting.result import FitResult
from lidardesign.formats.designs import relative_folder
from lidardesign.mixture.fit import FitProblem, FittedSensors, fit_sensors
from lidardesign.mixture.support import LEAST_SAMPLES, MOVED_SAMPLES, Retarget, at_condition, condition_text
from lidardesign.plugins import plugin_guard
from lidardesign.rays.information import FEW_SCENES, checked_information
from lidardesign.rays.proposals import nearest_samples
from lidardesign.rays.training_scenes import CHOICE, TrainingScenes
from lidardesign.run.clock import phase
from lidardesign.run.manifest import read_manifest, versions
from lidardesign.run.yaml import dump_yaml, merged, parse_yaml
from lidardesign.run_folder import Notes, ignore, log_note
from lidardesign.samples import Samples, load_samples
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document, digested
from lidardesign.space import DIMENSIONS
from lidardesign.task import mount_of, random_generator
from lidardesign.workers import Starmap

if TYPE_CHECKING:
    from lidardesign.rays.pool import CandidatePool
    from lidardesign.scoring.scene_scores import TrainingScorer

# A larger share of scenes without information from a design is noted.
MOST_SILENT = 0.5
# So much of what sensors see is seen by several, or a note says so where a sensor may fail.
LEAST_SHARED = 0.9


def fit_design(
    request: FitRequest,
    *,
    notes: Notes = log_note,
    progress: Notes = ignore,
    starmap: Starmap = itertools.starmap,
    samples: Samples | None = None,
    target: Retarget | None = None,
) -> FitResult:
    """Fit the design of a request and check it; nothing is written but what the run keeps of its scenes.

    Arguments:
        request: The request.
        notes: Called with every note.
        progress: Called with every step, as "choosing 361 rays".
        starmap: How training scenes are informed: in this process, or by workers.
        samples, target: Of another density than the run's, and its log p* at design points.

    Returns:
        The fit, whose design says where it came from and whose checks are of the design's own text.

    Raises:
        ConfigError: Choices that do not fit together.
        DataError: The density is too rough.
        InfeasibleError: Constraints that contradict each other, or that the design does not keep.
    """
    fitter = Fitter(request, notes, progress, starmap, samples, target)
    try:
        result = fitter.fit()
    except InfeasibleError as error:
        error.hint = _wider_run(request, error.conflicts) or error.hint
        raise
    for note in result.notes:
        notes(note)
    # of a goal it is found
    request = fitter.request
    run, design = request.run, result.design
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
    weighting = {KEY: {"set": list(request.weighting.settings)}} if request.weighting.settings else {}
    world = {WORLD: request.world} if request.world else {}
    with plugin_guard(run.task.name):
        mount = mount_of(run.task, run.config.task)
    design = replace(
        design,
        mount=mount,
        certificates=tuple(digested(one, design) for one in design.certificates),
        provenance={**design.provenance, **origin, **weighting, **world},
    )
    with phase("writing"):
        return replace(result, design=design, constraints=check_written(design, request))


def _wider_run(request: FitRequest, conflicts: Sequence[str]) -> str | None:
    """The command that learns a run with room for the places of constraints; None where those are no conflict."""
    names = [f"space.{name}" for name in DIMENSIONS[:3]]
    if not {*names} & {*conflicts}:
        return None
    run = request.run
    origins = [rules.origin for rules in request.constraints.rules]
    ends = np.stack([run.config.space.low[:3], run.config.space.high[:3]])
    boxes = [(one.low_m or ends[0], one.high_m or ends[1]) for one in origins if one.low_m or one.high_m]
    places = [
        *(place for one in origins for place in (one.fixed_m, *(one.mounts_m or ())) if place is not None),
        *(place for low, high in boxes for place in (low, np.maximum(low, high))),
    ]
    if not places:
        return None
    command = [str(word) for word in read_manifest(run.folder).get("command") or ()]
    words = [part for word in command for part in (word.split("=", 1) if word.startswith("--") else [word])]
    if "origin_m" in type(run.config.task).model_fields and "--out" in words:
        # directions and ranges then follow from the places, as the task has it
        low, high = np.min(places, axis=0), np.max(places, axis=0)
        wider = {"origin_m": (low + high) / 2, "origin_box_m": (high - low) / 2}
        given = [n for n, word in enumerate(words) if word == "--out" or word.partition("=")[0] in wider]
        gone = {n + shift for n in given for shift in ((0, 1) if words[n] == "--out" else (-1, 0))}
        words = [word for n, word in enumerate(words) if n not in gone]
    else:
        low, high = np.min([*ends, *places], axis=0), np.max([*ends, *places], axis=0)
        grown = [axis for axis in range(3) if low[axis] < ends[0, axis] or high[axis] > ends[1, axis]]
        wider = {names[axis]: np.array([low[axis], high[axis]]) for axis in grown}
        words = ["lidardesign", "learn", run.task.name, "--config", f"{run.folder}/{FILE_NAME}"]
    if not wider:
        return None
    for name, values in wider.items():
        words += ["--set", f"{name}=[{', '.join(f'{value:g}' for value in values)}]"]
    words += ["--out", f"{run.folder}-wide"]
    return f"loosen the constraint, or learn a run with room for it: {join(words)}"


def check_written(design: DesignSpec, request: FitRequest) -> tuple[ConstraintCheck, ...]:
    """Check a design's own text against its constraints with code that the fit does not share.

    Raises:
        InfeasibleError: A constraint does not hold.
    """
    written = parse_yaml(dump_yaml(design_document(design)), where=design.name).value
    checks = tuple(check_design(written, request.constraints, request.run.config.space))
    broken = [check for check in checks if not check.satisfied]
    if broken:
        first = broken[0]
        raise InfeasibleError(
            f"the best design found breaks {first.name}: {first.value}, bound {first.bound}",
            conflicts=[check.name for check in broken],
            hint="loosen one of the constraints; no file was written",
        )
    return checks if request.is_constrained else ()


class Fitter:
    """Fits designs of one request that differ in the number of their sensors.

    Arguments:
        request, notes, progress, starmap, samples, target: See `fit_design`.

    Raises:
        ConfigError: An invalid setting, or a name that is not a condition of the density.
        DataError: The density is too rough, with or without the settings.
    """

    def __init__(
        self,
        request: FitRequest,
        notes: Notes,
        progress: Notes,
        starmap: Starmap,
        samples: Samples | None,
        target: Retarget | None,
    ) -> None:
        run, settings = request.run, request.weighting.settings
        self.request, self.notes, self.progress = request, notes, progress
        self.target = target or RunTarget(run, weighting=request.weighting)
        run.config.space.at(request.at)
        with phase("samples"):
            loaded = load_samples(run.folder, run.config.space) if samples is None else samples
            self._check_effective(loaded, "learn longer (--preset standard or fine), or with a larger density.sigma_m")
            if settings:
                before = loaded.effective_sample_size
                loaded = replace(loaded, log_target=self.target(loaded.points))
                self._check_effective(loaded, "choose a setting nearer to the learned one, or learn with it")
                text = f"with {', '.join(settings)} the samples have ESS {loaded.effective_sample_size:.2f}"
                notes(BackgroundNote(f"{text}, and {before:.2f} as learned"))
                # scenes weigh their items by the same settings
                config = with_task_settings(run.task, run.config, settings, option=request.weighting.origin)
                run = replace(run, config=config)
            if request.at:
                generator = random_generator(request.seed, "condition")
                loaded = at_condition(loaded, request.at, self.target, MOVED_SAMPLES, generator)
                ess = loaded.effective_sample_size
                notes(BackgroundNote(f"at {condition_text(request.at)} {len(loaded)} samples have ESS {ess:.2f}"))
            self.samples = loaded
        # scenes are judged from where the design is
        seen = with_task_settings(run.task, run.config, request.settings) if request.settings else run.config
        here = replace(seen, space=run.config.space.at(request.at))
        self.training = TrainingScenes(replace(run, config=here), request.seed, starmap, keeps=samples is None)
        space = run.config.space
        is_fixed = {axis for axis in range(3) if axis in space.free} <= set(space.conditioned)
        self.is_pooled = samples is None and not settings and not request.at and is_fixed

    def _check_effective(self, samples: Samples, hint: str) -> None:
        """Refuse samples with an effective number below `LEAST_SAMPLES`."""
        effective = samples.independent
        if effective < LEAST_SAMPLES:
            raise DataError(
                f"the density is too rough: its {len(samples)} samples count as only {effective:.0f}",
                where=str(self.request.run.folder),
                allowed=f"at least {LEAST_SAMPLES}",
                hint=hint,
            )

    @cached_property
    def scorer(self) -> TrainingScorer:
        """The scorer of all trials."""
        # scoring loads compiled loops, which a given number of sensors does without
        from lidardesign.fitting.trials import held_back_scorer

        return held_back_scorer(self.training, self.request.planner)

    @cached_property
    def pool(self) -> CandidatePool | None:
        """The pool of candidate rays at the sensors' place; None where their origins are free."""
        if not self.is_pooled:
            return None
        # compiled, which even rays do without
        from lidardesign.rays.pool import pool_of

        return pool_of(self.request.run, self.samples, self.training, self.progress)

    def fit(self) -> FitResult:
        """The design of the request."""
        request = self.request
        if request.goal is not None:
            return self._to_goal()
        if request.constraints.parts is not None:
            return self._parts(request, self.notes)
        if request.layout == "spinning":
            from lidardesign.fitting.spinning import CHANNELS, choose_rings

            return choose_rings(
                self.samples,
                request.constraints,
                count=request.sensors or 1,
                channels=CHANNELS if request.channels is None else request.channels,
                rays=request.rays,
                informs=partial(checked_information, request.run.task),
                scenes=self.training.scenes,
                name=request.name,
            )
        if request.sensors == BEST:
            return self._without_idle(self._best_count())
        return self._fitted(request)

    def _to_goal(self) -> FitResult:
        """The design with the least that keeps the goal, as its request gives it without a goal."""
        from lidardesign.fitting.trials import GoalSearch

        request = self.request
        if request.sensors == BEST and request.least != "sensors":
            request = replace(request, sensors=self._best_count())

        def fit(asked: FitRequest) -> DesignSpec:
            limit = asked.constraints.budget.bandwidth_mbps
            named = {"sensors": asked.sensors, "rays": asked.rays, "Mbit/s": limit and f"{limit:g}"}
            self.progress(f"trying {', '.join(f'{value} {name}' for name, value in named.items() if value)}")
            if asked.constraints.parts is not None:
                return self._parts(asked, ignore).design
            return self._fitted(asked, certifies=False).design

        with phase("trials"):
            search = GoalSearch(request, fit, self.scorer)
            found = search.found(COUNTS)
        self.request = replace(found.request, goal=None)
        for note in search.notes(found):
            self.notes(note)
        return replace(self.fit(), goal=search.as_dict(found))

    def _without_idle(self, count: int) -> FitResult:
        """The design of at most `count` sensors, fewer while any would fire no ray or rest on too few samples."""
        least = self.request.constraints.least_sensors
        while count > least:
            try:
                result = self._fitted(replace(self.request, sensors=count), may_idle=True)
                fired = result.design.rays_per_sensor()
                idle = 0 if fired is None else int((fired == 0).sum())
                why = f"{idle} of {count} sensors would fire none of the rays"
            except InfeasibleError as error:
                if error.conflicts != ("--sensors",):
                    raise
                idle, why = 1, str(error.message)
            if not idle:
                return result
            count = max(count - idle, least)
            self.notes(f"{why}: fitted again with {count}")
        return self._fitted(replace(self.request, sensors=count))

    @phase("fitting")
    def _sensors(self, request: FitRequest, constraints: Constraints, rays: int | None) -> FittedSensors:
        samples = self.samples
        if samples.space.conditioned:
            # a sensor that moves along a condition looks everywhere the same way
            (place, *_) = request.run.conditions(samples.space)
            samples = nearest_samples(samples, place, 1.0)
        return fit_sensors(
            FitProblem(
                samples=samples,
                constraints=constraints,
                sensors=request.sensors,
                rays=rays,
                seed=request.seed,
                level=request.level,
                retarget=self.target,
                keeps_bandwidth=request.layout == "even",
            )
        )

    def _fitted(
        self, request: FitRequest, *, is_trial: bool = False, may_idle: bool = False, certifies: bool = True
    ) -> FitResult:
        """The design of a request whose number of sensors is known.

        Arguments:
            request: What is asked for.
            is_trial: Whether its number of sensors is being tried.
            may_idle: Whether sensors may be left without a ray.
            certifies: Whether chosen rays get their certificates, which no ray depends on.
        """
        started, constraints, counts = time.perf_counter(), request.constraints, request.counts
        is_chosen = request.layout == "chosen"
        fitted = self._sensors(request, constraints, counts[-1] if is_chosen else request.rays)
        if constraints.survive:
            check_several(len(fitted.sensors))
        design = DesignSpec(
            name=request.name,
            sensors=fitted.sensors,
            layout=request.layout,
            constraints=constraints.as_document(),
            level=request.level,
            at=dict(request.at),
        )
        notes = [*placement_notes(constraints.rules)]
        if is_chosen:
            from lidardesign.fitting.chosen import choose_rays

            middle = counts[len(counts) // 2]
            chosen = choose_rays(
                request,
                self.training,
                self.samples,
                fitted,
                pool=self.pool,
                certified=() if is_trial or not certifies else counts if request.certify else (middle,),
                each_fires=not may_idle,
                is_trial=is_trial,
                progress=ignore if is_trial else self.progress,
            )
            design = replace(design, sensors=chosen.sensors, patterns=chosen.patterns, certificates=chosen.certificates)
            if request.adaptive > 1 and not is_trial:
                design = self._if_better(replace(design, adaptive=chosen.adaptive), notes)
            if chosen.silent > MOST_SILENT:
                notes.append(
                    f"no ray has information about {chosen.silent:.0%} of the training scenes that were held back; "
                    "if that is unexpected, check that places, directions and gates are right, and in metres"
                )
            if chosen.shared < LEAST_SHARED:
                notes.append(
                    f"constraints let several sensors see only {chosen.shared:.0%} of what is seen: the rest is lost "
                    "with its sensor; allow wider fields of view or gates"
                )
        elif fitted.rays is not None:
            design = replace(design, constraints=merged(design.constraints, {"budget": {"rays": fitted.rays}}))
        return FitResult(
            design,
            fitted.log_likelihood.value,
            fitted.admissible_mass,
            fitted.ess,
            time.perf_counter() - started,
            notes=(*notes, *fitted.notes),
            error_estimates=fitted.estimates(self.samples),
        )

    def _if_better(self, design: DesignSpec, notes: list[str]) -> DesignSpec:
        """The design with its adaptive patterns where they score better on training scenes held back, else without.

        They do where the gain is more than its standard error.
        """
        from lidardesign.fitting.trials import best_of, trial_of

        metric, adaptive = self.request.run.metric, design.adaptive
        if adaptive is None:
            notes.append("one pattern: training scenes are too few or too similar for several, or bandwidth is too low")
            return design
        with phase("trials"):
            fixed = trial_of(self.request, design, len(adaptive))
            following = trial_of(self.request, design, len(adaptive), self.request.run.task)
            best = best_of([fixed, following], self.scorer, metric, 0.0, most=2 * FEW_SCENES)
        before, after = fixed.scores.mean(), following.scores.mean()
        looks = f" behind a first look of {adaptive.rule.looks} rays" if adaptive.rule.looks else ""
        text = (
            f"{len(adaptive.patterns)} patterns{looks} score {after:.4g} {metric.unit} on training scenes held back, "
            f"the best single one {before:.4g}"
        )
        if best is following:
            notes.append(text)
            return design
        notes.append(f"one pattern: {text}")
        return replace(design, adaptive=None)

    def _best_count(self) -> int:
        """The number of sensors that scores best on training scenes, with a note on those tried."""
        from lidardesign.fitting.trials import best_of, effects_line, trials_of

        request, metric = self.request, self.request.run.metric
        check_feasible(request.constraints, request.run.config.space, rays=request.rays)
        if not self.is_pooled:
            # all trials cast their candidates into the same scenes
            self.training.first(CHOICE)

        def fit(trial: FitRequest) -> DesignSpec:
            self.progress(f"trying --sensors {trial.sensors}")
            return self._fitted(trial, is_trial=True, may_idle=True).design

        with phase("trials"):
            trials = trials_of(request, fit, COUNTS)
            best = best_of(trials, self.scorer, metric)
        found = ", ".join(f"{one.sensors}: {one.scores.mean():.4g} in {one.mbps:.3g} Mbit/s" for one in trials)
        text = f"sensors: {best.sensors}; {metric.name} [{metric.unit}] on {len(best.scores)} training scenes "
        self.notes(BackgroundNote(f"{text}by their number: {found}"))
        for line in effects_line(self.scorer):
            self.notes(BackgroundNote(line))
        return best.sensors

    def _parts(self, request: FitRequest, notes: Notes) -> FitResult:
        from lidardesign.fitting.part_design import choose_parts

        return choose_parts(self.samples, request, self.training, notes, self.progress)
