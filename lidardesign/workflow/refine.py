"""How `fit` and `constrain` fit a design, and refine it on training scenes that were drawn for that."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from lidardesign.cli.tables.designs import number
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.clock import phase
from lidardesign.workflow.layouts import Layouts, RunTarget
from lidardesign.workflow.weighting import Weighting

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console as RichConsole

    from lidardesign.cli.output import Output
    from lidardesign.design.constraints.document import Constraints
    from lidardesign.design.fit import FitResult
    from lidardesign.evaluate.refinement.attention import Attention
    from lidardesign.evaluate.refinement.refinement import Refinement, Round, Shape, Trial
    from lidardesign.evaluate.refinement.regating import Gating
    from lidardesign.evaluate.refinement.reweighting import Reweighting
    from lidardesign.samples import Samples
    from lidardesign.scene import Scene
    from lidardesign.workflow.runs import Run

# The share of the training scenes whose residuals are looked at; the others judge.
LOOK_SHARE = 0.6
FEWEST_SCENES = 2
# So many places drawn from the density decide where the anchors are.
ANCHOR_POOL = 20_000
LEARN_LONGER = "learn longer (--preset standard or fine), or with a larger density.sigma_m"


@dataclass(frozen=True, eq=False)
class FitOrder:
    """What `fit` or `constrain` was asked for.

    Arguments:
        run: An opened run.
        name: The design's name.
        seed: Root of the random streams.
        constraints: Checked constraints, or None.
        at: Condition values that the design is for.
        choices: sensors, layout, rays, gates and level.
    """

    run: Run
    name: str
    seed: int
    constraints: Constraints | None
    at: Mapping[str, float]
    choices: Mapping[str, Any]

    @property
    def count(self) -> int:
        """The number of rays that a refined design is judged at: its own, else the task's middle budget."""
        budgets = sorted(self.run.task.defaults.rays)
        asked = None if self.constraints is None else self.constraints.budget.rays
        return self.choices.get("rays") or asked or budgets[len(budgets) // 2]


class Fitter:
    """Fits designs of one order under different weightings, which have the same settings of the task.

    Raises:
        ConfigError: A setting that cannot be, or a name that is no condition of the density.
        DataError: The density is too rough, with or without the settings.
    """

    def __init__(self, order: FitOrder, weighting: Weighting, console: Output) -> None:
        self.order, self.console = order, console
        settings_alone = replace(weighting, reweighting=None, range_spread_m=0.0)
        self.target = RunTarget(order.run, weighting=settings_alone)
        order.run.config.space.at(order.at)
        self.base = self._base(settings_alone)
        self._told = False

    @phase("samples")
    def _base(self, weighting: Weighting) -> Samples:
        """The samples of the run under the settings."""
        from lidardesign.samples import load_samples

        samples = load_samples(self.order.run.folder)
        _check_worth(samples, self.order.run, LEARN_LONGER)
        settings = weighting.settings
        if not settings:
            return samples
        weighed = weighting.log_target(samples, self.target)
        _check_worth(weighed, self.order.run, "a setting nearer to what was learned, or learn with it")
        now, before = weighed.effective_sample_size, samples.effective_sample_size
        self.console.note(f"note: with {', '.join(settings)} the samples have ESS {now:.2f}, as learned {before:.2f}")
        return weighed

    def samples(self, weighting: Weighting) -> Samples:
        """What designs are laid out by: of all conditions, weighted."""
        factor = weighting.reweighting
        samples = self.base if factor is None else self.base.reweighted(factor.log_factor(self.base.points))
        return weighting.spread(samples, self.order.run.config.seed)

    def usable(self, weighting: Weighting) -> Weighting:
        """The weighting without its spread in range where samples are moved and weighed anew."""
        if not weighting.range_spread_m or self.may_spread:
            return weighting
        self.console.note("note: samples that are aimed anew are not spread in range, as they were for the design")
        return replace(weighting, range_spread_m=0.0)

    def retarget(self, factor: Reweighting | None) -> Callable[[np.ndarray], np.ndarray]:
        """log p* with a factor; the target itself is prepared once."""
        if factor is None:
            return self.target
        return lambda points: self.target(points) + factor.log_factor(points)

    @phase("fitting")
    def fit(self, weighting: Weighting, samples: Samples, **choices: Any) -> FitResult:
        """The design under a weighting, from its samples."""
        from lidardesign.design.fit import fit as fit_design

        order, retarget = self.order, self.retarget(weighting.reweighting)
        if order.at:
            samples = self._at(samples, retarget)
        return fit_design(
            samples,
            constraints=order.constraints,
            seed=order.seed,
            name=order.name,
            retarget=retarget,
            **{**order.choices, **choices},
        )

    def _at(self, samples: Samples, retarget: Callable[[np.ndarray], np.ndarray]) -> Samples:
        """The samples at the order's conditions."""
        from lidardesign.design.layouts.quantise import SAMPLES_PER_RAY
        from lidardesign.design.mixture.conditions import MOVED_SAMPLES, at_condition, shown
        from lidardesign.task import random_generator

        order = self.order
        count = max(MOVED_SAMPLES, SAMPLES_PER_RAY * (order.choices.get("rays") or 0))
        moved = at_condition(samples, order.at, retarget, count, random_generator(order.seed, "condition"))
        worth = moved.effective_sample_size
        if not self._told:
            self.console.note(f"note: at {shown(order.at)} {len(moved)} samples have ESS {worth:.2f}")
        self._told = True
        return moved

    @cached_property
    def may_spread(self) -> bool:
        """Whether samples may be spread in range: not where weights at other places have to be worked out for them."""
        from lidardesign.design.constraints.origins import is_mounted
        from lidardesign.design.mixture.bounds import groups

        constraints = self.order.constraints
        if self.order.at:
            return False
        if constraints is None:
            return True
        members = groups(constraints.rules, self.base.space, max(len(constraints.each), 1) + 1)
        return not is_mounted(constraints.rules) and all(pin is None for group in members for pin in group.pins)


def fitted(order: FitOrder, weighting: Weighting, console: Output) -> tuple[FitResult, Weighting]:
    """A design as it was ordered."""
    fitter = Fitter(order, weighting, console)
    return fitter.fit(weighting, fitter.samples(weighting)), weighting


def refined(
    order: FitOrder, weighting: Weighting, rounds: int, console: Output
) -> tuple[tuple[FitResult, Weighting], dict[str, Any]]:
    """A design that was refined, how its samples are weighted, and how it went, for the document.

    Raises:
        ConfigError: The task does not say where its error is, or has too few training scenes.
    """
    from lidardesign.evaluate.scene_scores import gives_residuals

    run = order.run
    if not gives_residuals(run.task):
        raise ConfigError(
            f"the task {run.task.name} does not say where its error is",
            where="--refine",
            allowed="tasks with residuals",
            hint="leave --refine out, or give the task a method residuals(scene, returns)",
        )
    fitter = Fitter(order, weighting, console)
    found = _refine(fitter, weighting, rounds, console)
    shape = found.shape
    used = Weighting(weighting.settings, found.reweighting, shape.range_spread_m)
    return (found.trial.result, used), {"refinement": _document(found, run.task.metric.unit)}


def _refine(fitter: Fitter, weighting: Weighting, rounds: int, console: Output) -> Refinement:
    from lidardesign.evaluate.refinement.refinement import Refiner, Shape

    order, start = fitter.order, weighting.reweighting
    unit = order.run.task.metric.unit
    look, judge = _scenes(order)
    gating = _Gating(fitter, look)

    def told(one: Round) -> None:
        console.note(f"refine {one.number}: {_shown(one, unit)}")

    refiner = Refiner(
        order.run.task,
        lambda factor, shape: _trial(fitter, replace(weighting, reweighting=factor), shape, gating),
        look,
        judge,
        _attention(fitter, start),
        sigma_m=order.run.config.density.sigma_m,
        spreads=fitter.may_spread,
        progress=told,
    )
    shape = Shape(order.choices["level"], weighting.range_spread_m)
    return refiner.run(rounds, shape, None if start is None else start.log_factors)


def _attention(fitter: Fitter, start: Reweighting | None) -> Attention:
    """Anchors over the density, or those of what was found before, which then goes on."""
    from lidardesign.evaluate.refinement.attention import Attention, anchors_for
    from lidardesign.space import observed_point
    from lidardesign.task import conditions_of, random_generator

    run, seed = fitter.order.run, fitter.order.seed
    places = observed_point(fitter.base.resample(ANCHOR_POOL, random_generator(seed, "anchor places")))
    if start is not None:
        return Attention.at(start.points_m, places)
    positions = len(conditions_of(run.task, run.config.task, run.config.space))
    return Attention.over(places, random_generator(seed, "anchors"), anchors_for(positions))


class _Gating:
    """Gates by returns, from the scenes that are looked at and those that were learned from; made when asked for."""

    def __init__(self, fitter: Fitter, look: list[Scene]) -> None:
        self._fitter, self._look = fitter, look

    @cached_property
    def made(self) -> Gating:
        """The gating, with casters of all scenes."""
        from lidardesign.evaluate.refinement.regating import Gating
        from lidardesign.simulate.simulate import build_casters

        run = self._fitter.order.run
        scenes = [*self._look, *run.scenes("train", run.config.seed)]
        return Gating([(s, build_casters(s)) for s in scenes], run.config.space, run.config.density.sigma_m)


def _trial(fitter: Fitter, weighting: Weighting, shape: Shape, gating: _Gating) -> Trial:
    """A design of a weighting, and its rays at every condition.

    Raises:
        InfeasibleError: It cannot be fitted, or breaks a constraint.
    """
    from lidardesign.cli.commands.fit import refuse_broken
    from lidardesign.design.bandwidth import Bandwidth
    from lidardesign.evaluate.baselines.candidates import mean_mbps
    from lidardesign.evaluate.refinement.refinement import Trial
    from lidardesign.task import conditions_of

    order = fitter.order
    run = order.run
    weighting = replace(weighting, range_spread_m=shape.range_spread_m)
    samples = fitter.samples(weighting)
    result = fitter.fit(weighting, samples, level=shape.level)
    layouts = Layouts({order.name: fitter.retarget(weighting.reweighting)})
    conditions = conditions_of(run.task, run.config.task, run.config.space)
    count = result.design.rays or order.count
    if shape.traced_gates:
        rays = layouts(result.design, count, samples, at=conditions[0])
        design = gating.made(result.design, rays, shape.range_spread_m)
        result = _checked(replace(result, design=design), order)
    refuse_broken(result.constraints)
    positions = tuple(layouts(result.design, count, samples, at=condition) for condition in conditions)
    return Trial(result, positions, mean_mbps(positions, Bandwidth()))


def _checked(result: FitResult, order: FitOrder) -> FitResult:
    """A fit whose design was changed, checked anew."""
    from lidardesign.design.constraints.check import check_design
    from lidardesign.design.files import design_document

    constraints = order.constraints
    document = design_document(result.design)
    found = [] if constraints is None else check_design(document, constraints, order.run.config.space)
    return replace(result, constraints=list(found))


def _scenes(order: FitOrder) -> tuple[list[Scene], list[Scene]]:
    """Training scenes that nothing was learned from: some to look at, others to judge by.

    Raises:
        ConfigError: There are too few.
    """
    from lidardesign.task import random_generator

    seed = int(random_generator(order.seed, "refinement scenes").integers(2**31))
    scenes = order.run.scenes("train", seed)
    if len(scenes) < FEWEST_SCENES:
        raise ConfigError(
            f"{len(scenes)} training scene", where="--refine", allowed=f"at least {FEWEST_SCENES}",
            hint="some are looked at, the others judge: learn with more training scenes",
        )  # fmt: skip
    looked = min(max(round(LOOK_SHARE * len(scenes)), 1), len(scenes) - 1)
    return scenes[:looked], scenes[looked:]


def _check_worth(samples: Samples, run: Run, hint: str) -> None:
    """Refuse samples that are worth too few to fit anything to, whatever the constraints.

    Raises:
        DataError: They are worth fewer than a fit needs.
    """
    from lidardesign.design.mixture.support import LEAST_SAMPLES

    worth = samples.effective_sample_size * len(samples)
    if worth < LEAST_SAMPLES:
        raise DataError(
            f"the density is too rough: its {len(samples)} samples are worth {worth:.0f}",
            where=str(run.folder),
            allowed=f"at least {LEAST_SAMPLES}",
            hint=hint,
        )


def _document(found: Refinement, unit: str) -> dict[str, Any]:
    return {
        "start": found.start,
        "end": found.end,
        "unit": unit,
        "level": found.shape.level,
        "range_spread_m": found.shape.range_spread_m,
        "traced_gates": found.shape.traced_gates,
        "scenes": {"looked_at": found.looked_at, "judged_on": found.judged_on},
        "rounds": [one.as_dict() for one in found.rounds],
    }


def _shown(one: Round, unit: str) -> str:
    if one.score is None:
        return f"{one.change} (refused, {number(one.seconds, 2)} s)"
    verdict = "kept" if one.kept else "not better"
    return (
        f"{one.change}: {number(one.score)} {unit} at {number(one.bandwidth_mbps, 3)} Mbit/s, {verdict} "
        f"({number(one.seconds, 2)} s)"
    )


def show_refinement(document: Mapping[str, Any], rich: RichConsole) -> None:
    """Print what every round of a refinement brought."""
    from rich.markup import escape
    from rich.table import Table

    found = document.get("refinement")
    if found is None:
        return
    scenes = found["scenes"]
    title = (
        f"refinement: {scenes['looked_at']} training scenes to look at, score on {scenes['judged_on']} others "
        f"({number(found['start'])} to {number(found['end'])} {found['unit']})"
    )
    table = Table(title=title, title_justify="left")
    for heading in ("round", "change", found["unit"], "Mbit/s", "kept", "s"):
        table.add_column(heading, justify="left" if heading == "change" else "right")
    for one in found["rounds"]:
        figures = (number(one["score"]), number(one["bandwidth_mbps"], 3), "yes" if one["kept"] else "no")
        table.add_row(str(one["round"]), escape(one["change"]), *figures, number(one["seconds"], 2))
    rich.print(table)
