"""Real parts to buy, and where to mount them: `fit --parts`.

Parts are proposed at the mounts, or at places in the box of origins, facing what the density looks at, upright and
turned. Training scenes that the density was not learned from give their information, and the best few are chosen,
with a bound on the information of any other set of those proposed.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter

import numpy as np

from lidardesign.constraints.document import Constraints, SensorRules
from lidardesign.constraints.feasibility import BandwidthBudget, check_feasible
from lidardesign.constraints.origins import inside_excluded, mounts_of, origin_box
from lidardesign.errors import ConfigError, DataError, InfeasibleError
from lidardesign.fitting.part_sets import ChosenSet, SetLimits, choose_set
from lidardesign.fitting.part_shapes import PartBundle, PlacedPart, broken_keys, part_table, parts_inform, shapes_of
from lidardesign.fitting.request import FitResult
from lidardesign.mixture.bounds import bounds_of, clip_azimuth
from lidardesign.mixture.components import Axes
from lidardesign.numerics import TINY
from lidardesign.parts.catalogue import named_parts, part_rays, part_sensor
from lidardesign.parts.part import Part
from lidardesign.rays import information
from lidardesign.rays.certificate import certificate_document
from lidardesign.rays.coverage import Coverage, InformedScene
from lidardesign.rays.selection import are_enough
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays, Returns
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import MOST_FILE_RAYS
from lidardesign.sensors.pattern import Pattern, low_discrepancy
from lidardesign.sensors.sensor import DEFAULT_LEVEL, interval_factor
from lidardesign.simulate.calibration import reach_notes
from lidardesign.space import angles, observed_point
from lidardesign.task import Information, random_generator

MOST_POSES = 500  # of each kind of part, over all places
MOST_PLACES = 25  # in a box of origins
MOST_TOLD = 1_000_000  # candidates times scenes


def choose_parts(
    samples: Samples,
    constraints: Constraints,
    *,
    count: int,
    rays: int | None,
    informs: Callable[[Scene, Sequence[Returns]], Information],
    scenes: Callable[[str], Iterator[Scene]],
    seed: int,
    name: str,
    notes: Callable[[str], None],
    progress: Callable[[str], None],
) -> FitResult:
    """The design of the best few parts at their best poses.

    Arguments:
        samples: Samples of the density.
        constraints: The parts and their constraints.
        count: Largest number of parts.
        rays: Number of rays; None fires all that they have.
        informs: The task's information of a scene's returns.
        scenes: An endless stream of training scenes for a purpose, `choice` or `held back`.
        seed: Root of the random streams.
        name: The design's name.
        notes: Called with every note.
        progress: Called with every step.

    Raises:
        ConfigError: A part that is not there; a density with conditions.
        InfeasibleError: Constraints that contradict each other, or that no part keeps; fewer rays than parts.
        DataError: No part has information about the scenes.
    """
    started, space, wanted = perf_counter(), samples.space, constraints.parts
    check_feasible(constraints, space, sensors=count, rays=rays)
    if space.conditioned:
        raise ConfigError(
            "the density has conditions",
            where="--parts",
            allowed="tasks whose sensors do not move",
            hint="fit without parts",
        )
    every = named_parts(wanted.names, wanted.each)
    nearest = [part.name for part in every if part.value("near_m") is None]
    if nearest:
        left_out = "left out" if wanted.names == "catalog" else "taken as 0"
        notes(f"no source gives the shortest range of {', '.join(nearest)}: {left_out}")
    power = [] if wanted.power_w is None else [part.name for part in every if part.value("power_w") is None]
    if power:
        notes(f"no source gives the power of {', '.join(power)}: left out, since parts.power_w is bounded")
    unknown = {*power, *(nearest if wanted.names == "catalog" else ())}
    every = [part for part in every if part.name not in unknown]
    if not every:
        raise InfeasibleError(
            "no source gives the power of any of the parts",
            conflicts=["parts.power_w"],
            hint="leave parts.power_w out, or name parts whose power is known",
        )
    placed = proposed(every, constraints, samples, seed)
    budget = BandwidthBudget.of(constraints, rays)
    most = (budget.rays or MOST_FILE_RAYS) // count
    limits = _limits(placed, constraints, count, most, budget)
    if not limits.may_join((), len(placed)).any():
        bounded = {"budget.bandwidth_mbps": budget.limit_mbps, "parts.power_w": wanted.power_w}
        keys = [key for key, limit in bounded.items() if limit is not None]
        raise InfeasibleError(
            f"each of the parts needs more than {' or '.join(keys)} allows",
            conflicts=keys,
            hint="loosen one of the constraints named, or fire fewer rays",
        )
    bundle = PartBundle(placed, most, next(scenes("choice")).frames)
    chosen, coverage, held_back_loss, trained = _chosen_set(bundle, limits, informs, scenes, seed, progress)
    if len(chosen.members) < count:
        notes(f"{len(chosen.members)} of {count} parts: no further part tells more or fits the bounds")
    design = _design(name, constraints, [placed[member] for member in chosen.members], budget.rays)
    for line in reach_notes(design):
        notes(line)
    certificate = certificate_document(
        rays=design.count or 0,
        value=coverage.complete - chosen.value,
        bound=coverage.complete - chosen.bound,
        held_back_value=held_back_loss,
        candidates=len(placed),
        gates=1,
        scenes=len(trained),
        unit=trained[0].unit,
    )
    return FitResult.of_choice(replace(design, certificates=(certificate,)), samples, perf_counter() - started)


def _chosen_set(
    bundle: PartBundle,
    limits: SetLimits,
    informs: Callable[[Scene, Sequence[Returns]], Information],
    scenes: Callable[[str], Iterator[Scene]],
    seed: int,
    progress: Callable[[str], None],
) -> tuple[ChosenSet, Coverage, float, list[InformedScene]]:
    """The best set, the information of all parts, the set's loss on scenes held back, and the scenes of the choice.

    Raises:
        DataError: No part has information about the scenes.
    """
    inform = partial(parts_inform, bundle, informs=informs, count=limits.count, seed=seed)
    held_back = list(itertools.islice(scenes("held back"), information.FEW_SCENES))
    training, wanted, loss = scenes("choice"), information.FEW_SCENES, np.inf
    informed: list[InformedScene] = []
    while True:
        progress(f"choosing among {len(bundle.placed)} poses of parts on {wanted} training scenes")
        informed += inform(itertools.islice(training, wanted - len(informed)), first_scene=len(informed))
        coverage = part_table(informed, len(bundle.placed))
        with phase("choice"):
            chosen = choose_set(coverage, limits)
        if not chosen.members:
            raise DataError(
                "none of the parts tells anything about the scenes",
                where="--parts",
                hint="parts whose ranges reach the targets, or looser bounds of gate, boresight and origin",
            )
        judged = part_table(inform(held_back, among=chosen.members), len(chosen.members))
        before, loss = loss, judged.loss_of(np.zeros(len(chosen.members), dtype=np.intp))
        is_large = 2 * wanted > information.MOST_SCENES or 2 * wanted * len(bundle.placed) > MOST_TOLD
        if is_large or are_enough(before, loss, coverage.complete - chosen.value):
            return chosen, coverage, loss, informed
        wanted *= 2


def _limits(
    placed: Sequence[PlacedPart], constraints: Constraints, count: int, most_rays: int, budget: BandwidthBudget
) -> SetLimits:
    """Limits on sets of parts: their number, by kind and mount, their bandwidth and their power."""
    wanted = constraints.parts
    names = list(dict.fromkeys(one.part.name for one in placed))
    kinds = [
        (
            np.array([names.index(one.part.name) for one in placed]),
            np.array([wanted.each[name].max if name in wanted.each else count for name in names]),
        )
    ]
    if constraints.origin.mounts_m:
        place = np.array([one.place for one in placed])
        kinds.append((place, np.ones(place.max() + 1, dtype=np.intp)))
    budgets = []
    if budget.limit_mbps is not None:
        bits = [budget.model.mbps_of_widths(np.diff(one.shape.gate_m), min(one.part.rays, most_rays)) for one in placed]
        budgets.append((np.array(bits), budget.limit_mbps))
    if wanted.power_w is not None:
        budgets.append((np.array([one.part.value("power_w") for one in placed]), wanted.power_w))
    return SetLimits(count, kinds, budgets)


@phase("candidates")
def proposed(parts: Sequence[Part], constraints: Constraints, samples: Samples, seed: int) -> list[PlacedPart]:
    """Candidate parts at poses that the constraints allow.

    Raises:
        InfeasibleError: None keeps the constraints.
    """
    rules, space = constraints.rules[0], samples.space
    generator = random_generator(seed, "poses of parts")
    places, axes = _places(rules, samples, generator), Axes.of(space)
    kept = [ways for part in parts if (ways := shapes_of(part, space))]
    if not kept:
        raise InfeasibleError(
            "no part measures within the range of the design space", conflicts=["space.range_m", "parts"]
        )
    broken = [broken_keys(ways[0], rules) for ways in kept]
    kept = [ways for ways, keys in zip(kept, broken, strict=True) if not keys]
    if not kept or not len(places):
        keys = sorted(set().union(*broken)) if len(places) else ["origin"]
        raise InfeasibleError(
            f"no part satisfies {', '.join(keys)}",
            conflicts=[*keys, "parts"],
            hint="loosen one of them, or name other parts",
        )
    bounds = bounds_of(constraints.rules, space, (0,), interval_factor(DEFAULT_LEVEL))
    placed, points = [], observed_point(samples.resample(MOST_POSES, generator))
    for number, origin in enumerate(places):
        offset = points - origin
        # the middle of what is seen, and parts of it
        looking = np.concatenate([offset.mean(axis=0, keepdims=True), offset[number :: len(places)][1:]])
        azimuth, elevation = angles(looking / np.maximum(np.linalg.norm(looking, axis=1), TINY)[:, None])
        azimuth = clip_azimuth(azimuth, bounds)
        elevation = np.clip(elevation, bounds.elevation_low, bounds.elevation_high)
        aims = list(zip(azimuth.tolist(), elevation.tolist(), strict=True))
        for ways in kept:
            for turn, shape in enumerate(ways):
                # each way to mount a part has the middle, and its share of the others
                for aim in (aims[0], *aims[1 + turn :: len(ways)]):
                    placed.append(PlacedPart(shape, shape.pose(origin, *aim, 0.0, axes), number))
    return placed


def _places(rules: SensorRules, samples: Samples, generator: np.random.Generator) -> np.ndarray:
    """Places for parts: mounts, the one origin, or the density's origins and even points of their box, (P, 3) [m]."""
    if rules.origin.mounts_m:
        return np.array(mounts_of(rules), dtype=np.float64).reshape(-1, 3)
    low, high = origin_box(rules, samples.space)
    free = np.flatnonzero(high > low)
    if not len(free):
        return low[None]
    even = np.tile(low, (MOST_PLACES, 1))
    even[:, free] += low_discrepancy(MOST_PLACES, len(free)) * (high - low)[free]
    dense = samples.resample(MOST_POSES, generator)[:, :3]
    inside = ((dense >= low) & (dense <= high)).all(axis=1)
    kept = [one[~inside_excluded(one, rules)] for one in (dense[inside], even)]
    return np.concatenate([kept[0][: MOST_PLACES // 2], kept[1]])[:MOST_PLACES]


def _design(name: str, constraints: Constraints, placed: Sequence[PlacedPart], rays: int | None) -> DesignSpec:
    """The design of chosen parts with explicit rays, an even subset where they have more than wanted or a file holds.

    Raises:
        InfeasibleError: The parts have fewer rays than are asked for.
    """
    patterns = [one.part.rays for one in placed]
    total = min(sum(patterns), MOST_FILE_RAYS) if rays is None else rays
    if total > sum(patterns):
        raise InfeasibleError(
            f"the parts found have {sum(patterns)} rays, not {total}",
            conflicts=["--rays", "parts"],
            hint="fewer rays, more sensors, or parts with more rays",
        )
    counts = split_budget(np.array(patterns), total).tolist()
    tables = [part_rays(one.part, one.pose, count) for one, count in zip(placed, counts, strict=True)]
    sensors = []
    for index, (one, count) in enumerate(zip(placed, counts, strict=True)):
        start, end = one.shape.gate_m
        sensor = part_sensor(one.part, one.pose, name=f"s{index}", weight=count / total)
        sensors.append(replace(sensor, gate_m=(start, end)))
    gates = [np.tile(one.shape.gate_m, (count, 1)) for one, count in zip(placed, counts, strict=True)]
    fired = [
        replace(rays, gate_m=gate_m, sensor=np.full(len(rays), index), time_s=np.zeros(len(rays)))
        for index, (rays, gate_m) in enumerate(zip(tables, gates, strict=True))
    ]
    return DesignSpec(
        name=name,
        sensors=tuple(sensors),
        layout="fixed",
        patterns=(Pattern.of(Rays.joined(fired).as_angles()),),
        constraints=constraints.as_document(),
    )
