"""How a design is fitted, refined on training scenes that were drawn for that, and checked before anyone sees it.

The rounds of `--refine` run in `evaluate.refinement.Refiner.run`; here are its scenes, its trials and its result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.constraints.check import ConstraintCheck, check_design
from lidardesign.design.constraints.origins import is_mounted
from lidardesign.design.files import design_document
from lidardesign.design.fit import FitResult
from lidardesign.design.fit import fit as fit_samples
from lidardesign.design.layouts.quantise import SAMPLES_PER_RAY
from lidardesign.design.layouts.rays import LAYOUTS
from lidardesign.design.mixture.bounds import sensor_groups
from lidardesign.design.mixture.support import LEAST_SAMPLES, MOVED_SAMPLES, at_condition, condition_text
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import ConfigError, DataError, InfeasibleError
from lidardesign.run.clock import phase
from lidardesign.run.manifest import versions
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.samples import Samples, load_samples
from lidardesign.scene import Scene, group_numbers
from lidardesign.space import observed_point
from lidardesign.task import conditions_of, random_generator
from lidardesign.workflow.fit import FitRequest
from lidardesign.workflow.run_folder import Notes, RunFolder, log_note, relative_folder
from lidardesign.workflow.run_samples import KEY, Layouts, RunTarget, Weighting

if TYPE_CHECKING:
    from lidardesign.evaluate.refinement import Gating, Refinement, Round, Shape, Trial
    from lidardesign.evaluate.reweighting import Attention, Reweighting

# The share of the training scenes whose residuals are looked at; the others judge.
LOOK_SHARE = 0.6
FEWEST_SCENES = 2
# So many places drawn from the density decide where the anchors are.
ANCHOR_POOL = 20_000


class Fitter:
    """Fits designs of one request under different weightings, which have the same settings of the task.

    Raises:
        ConfigError: A setting that cannot be, or a name that is no condition of the density.
        DataError: The density is too rough, with or without the settings.
    """

    def __init__(self, request: FitRequest, notes: Notes = log_note) -> None:
        self.request, self.notes = request, notes
        settings_alone = replace(request.weighting, reweighting=None, range_spread_m=0.0)
        self.target = RunTarget(request.run, weighting=settings_alone)
        request.run.config.space.at(request.at)
        self._has_noted_condition = False
        with phase("samples"):
            self.base = load_samples(request.run.folder)
            self._check_effective_samples("learn longer (--preset standard or fine), or with a larger density.sigma_m")
            if request.weighting.settings:
                before = self.base.effective_sample_size
                self.base = settings_alone.log_target(self.base, self.target)
                self._check_effective_samples("a setting nearer to what was learned, or learn with it")
                now, settings = self.base.effective_sample_size, ", ".join(request.weighting.settings)
                notes(f"with {settings} the samples have ESS {now:.2f}, as learned {before:.2f}")

    def _check_effective_samples(self, hint: str) -> None:
        """Refuse samples of which too few are effective to fit anything to, whatever the constraints."""
        effective = self.base.effective_sample_size * len(self.base)
        if effective < LEAST_SAMPLES:
            raise DataError(
                f"the density is too rough: its {len(self.base)} samples are worth {effective:.0f}",
                where=str(self.request.run.folder),
                allowed=f"at least {LEAST_SAMPLES}",
                hint=hint,
            )

    def samples(self, weighting: Weighting) -> Samples:
        """What designs are laid out by: of all conditions, weighted."""
        factor = weighting.reweighting
        samples = self.base if factor is None else self.base.reweighted(factor.log_factor(self.base.points))
        return weighting.spread(samples, self.request.run.config.seed)

    def retarget(self, factor: Reweighting | None) -> Callable[[np.ndarray], np.ndarray]:
        """log p* with a factor; the target itself is prepared once."""
        return self.target if factor is None else lambda points: self.target(points) + factor.log_factor(points)

    @phase("fitting")
    def fit(self, weighting: Weighting, samples: Samples, **choices: Any) -> FitResult:
        """The design under a weighting, from its samples."""
        request, retarget = self.request, self.retarget(weighting.reweighting)
        if request.at:
            count = max(MOVED_SAMPLES, SAMPLES_PER_RAY * (request.choices.get("rays") or 0))
            samples = at_condition(samples, request.at, retarget, count, random_generator(request.seed, "condition"))
            if not self._has_noted_condition:
                place, ess = condition_text(request.at), samples.effective_sample_size
                self.notes(f"at {place} {len(samples)} samples have ESS {ess:.2f}")
            self._has_noted_condition = True
        return fit_samples(
            samples,
            constraints=request.constraints,
            seed=request.seed,
            name=request.name,
            retarget=retarget,
            **{**request.choices, **choices},
        )

    @cached_property
    def may_spread(self) -> bool:
        """Whether samples may be spread in range: not where weights at other places have to be worked out for them."""
        constraints = self.request.constraints
        if self.request.at or constraints is None:
            return not self.request.at
        members = sensor_groups(constraints.rules, self.base.space, max(len(constraints.each), 1) + 1)
        return not is_mounted(constraints.rules) and all(pin is None for group in members for pin in group.pins)


def fit_design(
    request: FitRequest, *, progress: Callable[[Round], None] | None = None, notes: Notes = log_note
) -> tuple[FitResult, Mapping[str, Any] | None]:
    """Fit the design of a request, refine it if asked to, and check it; nothing is written.

    Arguments:
        request: What is asked for.
        progress: Called with every round of refinement.
        notes: Called with every note.

    Returns:
        The fit, whose design says where it came from and whose checks are of the design's own text; and how refinement
        went, as plain values, None without.

    Raises:
        ConfigError: Choices that do not fit together, or a task that cannot be refined for.
        DataError: The density is too rough.
        InfeasibleError: Constraints that contradict each other, or that the best design does not keep.
    """
    run, weighting, document = request.run, request.weighting, None
    if request.refine is None:
        fitter = Fitter(request, notes)
        samples = fitter.samples(weighting)
        if LAYOUTS[request.choices["layout"]].chosen_on_scenes:
            result = _selected(request, fitter, samples)
        else:
            result = fitter.fit(weighting, samples)
    else:
        refinement = _refined(request, request.refine, progress, notes)
        result = refinement.trial.result
        weighting = Weighting(weighting.settings, refinement.reweighting, refinement.shape.range_spread_m)
        document = {
            "start": refinement.start,
            "end": refinement.end,
            "unit": run.metric.unit,
            "level": refinement.shape.level,
            "range_spread_m": refinement.shape.range_spread_m,
            "traced_gates": refinement.shape.traced_gates,
            "scenes": {"looked_at": refinement.looked_at, "judged_on": refinement.judged_on},
            "rounds": [entry.as_dict() for entry in refinement.rounds],
        }
    for note in result.notes:
        notes(note)
    design, further = result.design, {KEY: weighting.as_document()} if weighting else {}
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
    design = replace(design, provenance={**design.provenance, **origin, **further})
    with phase("writing"):
        checks = check_written(design, request)
    # broken ones were refused
    return replace(result, design=design, constraints=checks, satisfied=True), document


def _selected(request: FitRequest, fitter: Fitter, samples: Samples) -> FitResult:
    """Sensors with rays that were chosen on scenes: of the number that was asked for, or of each of the task's."""
    from lidardesign.workflow.select_rays import select_rays

    counts = sorted({request.choices["rays"]} if request.choices["rays"] else set(request.run.task.defaults.rays))
    # sensors' own gates keep a bandwidth themselves, those of rays are priced when they are chosen
    layout = "density" if request.choices["gates"] == "ray" else "grid"
    fitted = fitter.fit(request.weighting, samples, layout=layout, rays=counts[-1])
    gates = request.choices["gates"] or LAYOUTS["selected"].usual_gates
    fitted = replace(fitted, design=replace(fitted.design, gates=gates))
    return select_rays(request.run, fitted, counts, samples, request.seed)


def check_written(design: DesignSpec, request: FitRequest) -> list[ConstraintCheck]:
    """Check a design's own text against its constraints with code that the fit does not share.

    Raises:
        InfeasibleError: A constraint does not hold.
    """
    if request.constraints is None:
        return []
    written = parse_yaml(dump_yaml(design_document(design)), where=design.name).value
    checks = list(check_design(written, request.constraints, request.run.config.space))
    refuse_broken(checks)
    return checks


def refuse_broken(checks: Sequence[ConstraintCheck]) -> None:
    """Refuse a design that breaks a constraint.

    Raises:
        InfeasibleError: It does.
    """
    broken = [check for check in checks if not check.satisfied]
    if broken:
        first = broken[0]
        raise InfeasibleError(
            f"the best design found breaks {first.name}: {first.value}, bound {first.bound}",
            conflicts=[check.name for check in broken],
            hint="loosen one of the constraints; no file was written",
        )


def _refined(request: FitRequest, rounds: int, progress: Callable[[Round], None] | None, notes: Notes) -> Refinement:
    """The best design of so many rounds.

    Raises:
        ConfigError: The task does not say where its error is, or has too few training scenes.
    """
    from lidardesign.evaluate.refinement import Refiner, Shape
    from lidardesign.evaluate.scene_scores import gives_residuals

    run, weighting = request.run, request.weighting
    if not gives_residuals(run.task):
        raise ConfigError(
            f"the task {run.task.name} does not say where its error is",
            where="--refine",
            allowed="tasks with residuals",
            hint="leave --refine out, or give the task a method residuals(scene, returns)",
        )
    fitter = Fitter(request, notes)
    start = weighting.reweighting
    look, judge = refinement_scenes(request)
    gating = cache(lambda: _gating(run, look))
    refiner = Refiner(
        run.task,
        run.metric,
        lambda factor, shape: _trial(fitter, replace(weighting, reweighting=factor), shape, gating),
        look,
        judge,
        _attention(fitter, start),
        sigma_m=run.config.density.sigma_m,
        spreads=fitter.may_spread,
        progress=progress,
    )
    shape = Shape(request.choices["level"], weighting.range_spread_m)
    return refiner.run(rounds, shape, None if start is None else start.log_factors)


def _attention(fitter: Fitter, start: Reweighting | None) -> Attention:
    """Anchors over the density, or those of an earlier refinement, which then goes on."""
    from lidardesign.evaluate.reweighting import Attention, anchors_for

    run, seed = fitter.request.run, fitter.request.seed
    places = observed_point(fitter.base.resample(ANCHOR_POOL, random_generator(seed, "anchor places")))
    if start is not None:
        return Attention.at(start.points_m, places)
    count = anchors_for(len(conditions_of(run.task, run.config.task, run.config.space)))
    return Attention.over(places, random_generator(seed, "anchors"), count)


def _gating(run: RunFolder, look: Sequence[Scene]) -> Gating:
    """Gates by returns, from the scenes that are looked at and those that were learned from."""
    from lidardesign.evaluate.refinement import Gating
    from lidardesign.simulate.simulate import build_casters

    casters = [(scene, build_casters(scene)) for scene in (*look, *run.scenes("train", run.config.seed))]
    return Gating(casters, run.config.space, run.config.density.sigma_m)


def _trial(fitter: Fitter, weighting: Weighting, shape: Shape, gating: Callable[[], Gating]) -> Trial:
    """A design of a weighting, and its rays at every condition.

    Raises:
        InfeasibleError: It cannot be fitted, or breaks a constraint.
    """
    from lidardesign.evaluate.baselines.candidates import mean_mbps
    from lidardesign.evaluate.refinement import Trial

    request = fitter.request
    run, constraints = request.run, request.constraints
    weighting = replace(weighting, range_spread_m=shape.range_spread_m)
    samples = fitter.samples(weighting)
    result = fitter.fit(weighting, samples, level=shape.level)
    layouts = Layouts({request.name: fitter.retarget(weighting.reweighting)})
    conditions = conditions_of(run.task, run.config.task, run.config.space)
    count = result.design.rays or request.judged_rays
    if shape.traced_gates:
        rays = layouts(result.design, count, samples, at=conditions[0])
        design = gating()(result.design, rays, shape.range_spread_m)
        document = design_document(design)
        checks = [] if constraints is None else list(check_design(document, constraints, run.config.space))
        result = replace(result, design=design, constraints=checks)
    refuse_broken(result.constraints)
    positions = tuple(layouts(result.design, count, samples, at=condition) for condition in conditions)
    return Trial(result, positions, mean_mbps(positions, Bandwidth()))


def refinement_scenes(request: FitRequest) -> tuple[list[Scene], list[Scene]]:
    """Training scenes that nothing was learned from: some to look at, others to judge by, of other groups if it can be.

    Raises:
        ConfigError: There are too few.
    """
    seed = random_generator(request.seed, "refinement scenes").integers(2**31)
    scenes = request.run.scenes("train", int(seed))
    if len(scenes) < FEWEST_SCENES:
        raise ConfigError(
            f"{len(scenes)} training scene", where="--refine", allowed=f"at least {FEWEST_SCENES}",
            hint="some are looked at, the others judge: learn with more training scenes",
        )  # fmt: skip
    groups = group_numbers(scenes)
    if not groups.any():
        groups = np.arange(len(scenes))
    count = int(groups.max()) + 1
    looked = groups < min(max(round(LOOK_SHARE * count), 1), count - 1)
    return list(compress(scenes, looked)), list(compress(scenes, ~looked))
