"""What pictures need beside the scores, from what an evaluation was asked for: nothing is drawn here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from lidardesign.design.constraints.check import check_design
from lidardesign.design.constraints.slack import SPACE_MARK, ConstraintSlack, constraint_slack
from lidardesign.design.files import design_document
from lidardesign.design.layouts.track import placed
from lidardesign.design.sensor import DesignSpec
from lidardesign.evaluate.entries import ordered_conditions
from lidardesign.evaluate.figures.density_views import DensityView, density_view
from lidardesign.evaluate.figures.scene_figure import Conditions, Shown, shown_in
from lidardesign.evaluate.request import EvaluationRequest, fired_numbers, pattern_size
from lidardesign.evaluate.results import Evaluation
from lidardesign.geometry.rays import Rays
from lidardesign.space import DesignSpace


@dataclass(frozen=True, eq=False)
class Pictured:
    """What is drawn beside the scores.

    Arguments:
        shown: The designs in a scene.
        density: The learned density, where the run has its samples.
        tightness: How tight each design's constraints are, by its name.
        times: Where the time of each command went, as a clock tells it.
    """

    shown: Shown | None = None
    density: DensityView | None = None
    tightness: Mapping[str, Sequence[ConstraintSlack]] = field(default_factory=dict)
    times: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def pictured_of(
    evaluation: Evaluation, request: EvaluationRequest, times: Mapping[str, Mapping[str, float]]
) -> Pictured:
    """Everything that can be drawn of an evaluation's designs, in its first held-out scene."""
    return Pictured(
        shown_of(request, physics=any(effect.on for effect in evaluation.effects)),
        density_of(request),
        {design.name: tightness_of(design, request.space) for design in request.designs},
        times,
    )


def shown_of(request: EvaluationRequest, *, physics: bool) -> Shown:
    """The designs in the first held-out scene, with the physics that it calls for or by geometry alone."""

    most = max(fired_numbers(request.designs, request.rays))

    def laid_out(design: DesignSpec, at: Conditions) -> Rays:
        count = design.rays or pattern_size(design) or most
        return request.lay_out(design, count, request.samples.get(design.name), at=at)

    return shown_in(
        request.test[0],
        request.designs,
        ordered_conditions(request),
        placed,
        laid_out,
        planner=request.planner if physics else None,
        seed=request.seed,
    )


def density_of(request: EvaluationRequest) -> DensityView | None:
    """Views of what was learned; None where no run left samples."""
    density = request.density() if request.density is not None else None
    return None if density is None else density_view(density.samples, request.test[0], request.designs)


def tightness_of(design: DesignSpec, space: DesignSpace) -> list[ConstraintSlack]:
    """How tight each constraint of a design is, by the independent checker; the bounds of its space last."""
    checks = check_design(design_document(design), design.constraints, space)
    found = constraint_slack(checks, [sensor.name for sensor in design.sensors])
    return sorted(found, key=lambda one: one.name.startswith(SPACE_MARK))
