"""Real parts to buy, and where to mount them: `fit --parts`.

Parts are proposed at the mounts, or at places in the box of origins, facing what the density looks at, upright and
turned. Training scenes that the density was not learned from give their information. The best few by it, with a bound
on the information of any other set of those proposed, and other good sets are judged by the task's own score on scenes
that were held back, under the detector that is asked for; the best of these is taken.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any, TypeVar

import numpy as np

from lidardesign.constraints.document import Constraints, SensorRules
from lidardesign.constraints.feasibility import BandwidthBudget, check_feasible
from lidardesign.constraints.origins import inside_excluded, mounts_of, origin_box
from lidardesign.errors import BackgroundNote, ConfigError, InfeasibleError
from lidardesign.fitting.part_sets import ChosenSet, SetLimits, choose_set, further_sets, value_of
from lidardesign.fitting.part_shapes import (
    PartBundle,
    PartShape,
    PlacedPart,
    broken_keys,
    part_table,
    parts_inform,
    shapes_of,
)
from lidardesign.fitting.request import FitRequest
from lidardesign.fitting.result import FitResult
from lidardesign.fitting.trials import Trial, best_of, effects_line, held_back_scorer, score_trials
from lidardesign.mixture.bounds import bounds_of, clip_azimuth
from lidardesign.mixture.components import Axes
from lidardesign.numerics import SLACK, TINY
from lidardesign.parts.catalogue import named_parts, part_rays, part_sensor
from lidardesign.parts.part import Part
from lidardesign.rays import information
from lidardesign.rays.certificate import certificate_document
from lidardesign.rays.coverage import Coverage
from lidardesign.rays.training_scenes import CHOICE, HELD_BACK, SceneInformation, TrainingScenes, are_enough
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.fired import fired
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import MOST_FILE_RAYS
from lidardesign.sensors.pattern import Pattern, low_discrepancy
from lidardesign.sensors.sensor import DEFAULT_LEVEL, Sensor, interval_factor
from lidardesign.simulate.calibration import reach_notes
from lidardesign.simulate.detector.physics import IDEAL, Detector, check_windows
from lidardesign.space import angles, observed_point
from lidardesign.task import Metric, random_generator

MOST_JUDGED = 8  # sets of a number of parts, by the task's score; twice as many under a detector
JUDGED_FRAMES = 2000  # that the last sets are scored in at most, or twice as many scenes as at first
MOST_POSES = 500  # of each kind of part, over all places
MOST_PLACES = 25  # in a box of origins
MOST_TOLD = 1_000_000  # candidates times scenes
Found = TypeVar("Found")


@dataclass(eq=False)
class SetTrial(Trial):
    """A set of parts that is tried.

    Arguments:
        members: The parts, as numbers of candidates.
        bound: An upper bound of the information of any set of as many.
        design: Its design.
    """

    members: tuple[int, ...] = ()
    bound: float = np.inf
    design: DesignSpec | None = None


def choose_parts(
    samples: Samples,
    request: FitRequest,
    training: TrainingScenes,
    notes: Callable[[str], None],
    progress: Callable[[str], None],
) -> FitResult:
    """The design of the best few parts at their best poses.

    Arguments:
        samples: Samples of the density.
        request: What is asked for.
        training: Training scenes, in the world that is asked for.
        notes: Called with every note.
        progress: Called with every step.

    Raises:
        ConfigError: A part that is not there; a density with conditions.
        InfeasibleError: Constraints that contradict each other, or that no part keeps; fewer rays than parts; no part
            has information about the scenes.
    """
    started, space, constraints, count = perf_counter(), samples.space, request.constraints, request.sensors
    check_feasible(constraints, space, sensors=request.fewest or count, rays=request.rays)
    if space.conditioned:
        raise ConfigError(
            "the density has conditions",
            where="--parts",
            allowed="tasks whose sensors do not move",
            hint="fit without parts",
        )
    planner = request.planner
    detector = IDEAL if planner is None else planner.detector
    parts = _known_parts(constraints, notes)
    placed = _covered(proposed(parts, constraints, count, samples, request.seed), detector, notes)
    budget = BandwidthBudget.of(constraints, request.rays)
    most = (budget.rays or MOST_FILE_RAYS) // count
    limits = _limits(placed, constraints, count, most, budget)
    if not limits.may_join((), len(placed)).any():
        bounded = {"budget.bandwidth_mbps": budget.limit_mbps, **constraints.parts.sums}
        keys = [key for key, limit in bounded.items() if limit is not None]
        raise InfeasibleError(
            f"each of the parts needs more than {' or '.join(keys)} allows",
            conflicts=keys,
            hint="loosen one of the constraints named, or fire fewer rays",
        )
    bundle = PartBundle(placed, most, training.first(HELD_BACK)[0].frames, detector)
    informs = partial(information.checked_information, training.run.task)
    inform = partial(parts_inform, bundle, informs=informs, count=count, seed=request.seed)
    # under a detector information ranks sets little: it proposes more of them, on fewer scenes, and the score decides
    most_scenes = information.MOST_SCENES if planner is None else 2 * information.FEW_SCENES
    coverage, chosen, trained = _enough_scenes(bundle, limits, inform, training, most_scenes, progress)

    def trial(members: tuple[int, ...], bound: float) -> SetTrial:
        # sensors come in the order of their entries
        ordered = sorted((placed[member] for member in members), key=lambda one: one.entry)
        design = _design(request.name, constraints, ordered, budget.rays)
        return SetTrial(len(members), fired(design, planner=planner), members=members, bound=bound, design=design)

    numbers, judged = range(request.fewest or count, count + 1), MOST_JUDGED * (1 if planner is None else 2)
    by_number = _sets_by_number(numbers, coverage, limits, chosen, judged, trial)
    found = _judge_sets(by_number, training, request, notes, progress)
    rows = [_row(one, placed) for one in found] if request.fewest else []
    for row in rows:
        notes(_row_text(row, request.run.metric))
    sign = request.run.metric.sign
    winner = min(found, key=lambda one: sign * one.scores[: min(len(one.scores) for one in found)].sum())
    missing = {*range(len(constraints.each))} - {placed[member].entry for member in winner.members}
    if missing:
        raise InfeasibleError(
            f"no part where each[{min(missing)}] wants it sees anything that the others do not",
            conflicts=[f"each[{min(missing)}]"],
            hint="another place or boresight for it, or fewer entries",
        )
    if len(winner.members) < count and not request.fewest:
        notes(f"{len(winner.members)} of {count} parts: no other part adds anything or fits the bounds")
    parts = [placed[member].part for member in winner.members]
    for line in (*_price_notes(parts), *_place_notes(winner.design), *reach_notes(winner.design)):
        notes(line)
    told = part_table(inform(training.first(HELD_BACK), among=winner.members), len(winner.members))
    certificate = certificate_document(
        rays=winner.design.count or 0,
        value=coverage.complete - value_of(coverage, winner.members),
        bound=coverage.complete - winner.bound,
        held_back_value=told.loss_of(np.zeros(len(winner.members), dtype=np.intp)),
        candidates=len(placed),
        gates=1,
        scenes=len(trained),
        unit=trained[0].unit,
    )
    design = replace(winner.design, certificates=(certificate,))
    seconds = perf_counter() - started
    return FitResult(design, None, None, samples.effective_sample_size, seconds, numbers=tuple(rows))


def _sets_by_number(
    numbers: range,
    coverage: Coverage,
    limits: SetLimits,
    largest: ChosenSet,
    most: int,
    trial: Callable[[tuple[int, ...], float], SetTrial],
) -> list[list[SetTrial]]:
    """The best sets of each number of parts by their information, up to the first that gains nothing by another part.

    Arguments:
        numbers: The numbers.
        coverage: The information of all parts.
        limits: On sets of the largest number.
        largest: The best set of that number.
        most: The largest number of sets.
        trial: Makes a trial of the members of a set and the bound of its number.
    """
    by_number: list[list[SetTrial]] = []
    for number in numbers:
        fewer = replace(limits, count=number)
        with phase("choice"):
            best = largest if number == numbers[-1] else choose_set(coverage, fewer)
            sets = further_sets(coverage, fewer, best.members, most)
        if by_number and len(best.members) < number:
            break
        by_number.append([trial(best.members, best.bound)])
        for members in sets[1:]:
            with suppress(InfeasibleError):  # fewer rays than are asked for
                by_number[-1].append(trial(members, best.bound))
    return by_number


def _place_notes(design: DesignSpec) -> list[str]:
    """A line on parts that stand at one place."""
    here: dict[tuple[float, ...], list[str]] = {}
    for sensor in design.sensors:
        here.setdefault(tuple(np.round(sensor.origin_m, 3).tolist()), []).append(sensor.name)
    several = [", ".join(names) for names in here.values() if len(names) > 1]
    if not several:
        return []
    return [f"{'; '.join(several)} stand in the same place: mount them together, or list places in origin.mounts_m"]


def _price_notes(parts: Sequence[Part]) -> list[str]:
    """A line on what parts cost together, where any price is known."""
    prices = [part.value("price") for part in parts]
    unknown = ", ".join(dict.fromkeys(part.name for part in parts if part.value("price") is None))
    without = f", without {unknown}, whose price is unknown" if unknown else ""
    return [f"the parts cost {sum(filter(None, prices)):.6g} in all{without}"] if any(prices) else []


def _known_parts(constraints: Constraints, notes: Callable[[str], None]) -> list[Part]:
    """The parts that are named, without those whose range, power or price is not known where it has to be.

    Raises:
        InfeasibleError: None is left.
    """
    wanted = constraints.parts
    every = named_parts(wanted.names, wanted.each)
    nearest = [part.name for part in every if part.value("near_m") is None]
    if nearest:
        left_out = "left out" if wanted.names == "catalog" else "taken as 0"
        notes(f"no source gives the shortest range of {', '.join(nearest)}: {left_out}")
    unknown = {*(nearest if wanted.names == "catalog" else ())}
    for key, (name, _) in wanted.sums.items():
        lacking = [part.name for part in every if part.value(name) is None]
        if lacking:
            figure = name.removesuffix("_w")
            notes(f"no source gives the {figure} of {', '.join(lacking)}: left out, since {key} is bounded")
        if unknown.issuperset(part.name for part in every if part.name not in lacking):
            raise InfeasibleError(
                f"no source gives the {name.removesuffix('_w')} of any of the parts",
                conflicts=[key],
                hint=f"leave {key} out, or name parts for which it is known",
            )
        unknown |= {*lacking}
    return [part for part in every if part.name not in unknown]


def _covered(placed: list[PlacedPart], detector: Detector, notes: Callable[[str], None]) -> list[PlacedPart]:
    """Those parts whose gates the histogram of a detector covers.

    Raises:
        ConfigError: None.
    """
    fails: dict[str, ConfigError] = {}
    for one in {one.part.name: one for one in placed}.values():
        try:
            check_windows(np.array([one.shape.gate_m]), detector)
        except ConfigError as error:
            fails[one.part.name] = error
    kept = [one for one in placed if one.part.name not in fails]
    if not kept:
        raise next(iter(fails.values()))
    if fails:
        notes(f"{detector.name} does not cover the ranges of {', '.join(fails)}: left out")
    return kept


def _timed(scenes: Iterable[Found], count: int, label: str, progress: Callable[[str], None]) -> Iterator[Found]:
    """Scenes as they come, with the time left for so many of them in a label."""
    began = perf_counter()
    for number, scene in enumerate(itertools.islice(scenes, count)):
        left = f", about {(perf_counter() - began) * (count - number) / number:.0f} s for these" if number else ""
        progress(f"{label}{left}")
        yield scene


def _enough_scenes(
    bundle: PartBundle,
    limits: SetLimits,
    inform: Callable[..., list[SceneInformation]],
    training: TrainingScenes,
    most: int,
    progress: Callable[[str], None],
) -> tuple[Coverage, ChosenSet, list[SceneInformation]]:
    """The information of all parts about enough scenes, at most so many, the best set by it, and the scenes.

    Raises:
        InfeasibleError: No part has information about the scenes.
    """
    held_back, scenes = training.first(HELD_BACK), training.scenes(CHOICE)
    wanted, loss = information.FEW_SCENES, np.inf
    informed: list[SceneInformation] = []
    while True:
        label = f"choosing among {len(bundle.placed)} poses of parts on {wanted} training scenes"
        informed += inform(_timed(scenes, wanted - len(informed), label, progress), first_scene=len(informed))
        coverage = part_table(informed, len(bundle.placed))
        with phase("choice"):
            chosen = choose_set(coverage, limits)
        if not chosen.members:
            raise InfeasibleError(
                "none of the parts has information about the scenes",
                where="--parts",
                hint="parts whose ranges reach the targets, or looser bounds of gate, boresight and origin",
            )
        judged = part_table(inform(held_back, among=chosen.members), len(chosen.members))
        before, loss = loss, judged.loss_of(np.zeros(len(chosen.members), dtype=np.intp))
        is_large = 2 * wanted > most or 2 * wanted * len(bundle.placed) > MOST_TOLD
        if is_large or are_enough(before, loss, coverage.complete - chosen.value):
            return coverage, chosen, informed
        wanted *= 2


def _judge_sets(
    by_number: Sequence[list[SetTrial]],
    training: TrainingScenes,
    request: FitRequest,
    notes: Callable[[str], None],
    progress: Callable[[str], None],
) -> list[SetTrial]:
    """The best set of each number of parts by the task's score on training scenes that were held back."""
    trials, metric = [one for sets in by_number for one in sets], request.run.metric
    scorer = held_back_scorer(training, request.planner)
    if len(trials) == 1 and scorer.planner is None and not request.fewest:
        return trials
    few = max(information.FEW_SCENES // 4, 1)
    # together first: the effects are those that any of the sets calls for
    for number in range(1, few + 1):
        began = perf_counter()
        score_trials(trials, scorer, number)
        left = (perf_counter() - began) * (few - number)
        progress(f"judging {len(trials)} sets of parts on the first {few} scenes, about {left:.0f} s for these")
    if all(abs(one.scores.mean() - metric.worst) <= metric.tolerance for one in trials):
        notes("none of the sets measures anything in these scenes: the best by the proxy is taken")
        return [sets[0] for sets in by_number]
    most = min(max(JUDGED_FRAMES // scorer.scenes(1)[0].frames, 2 * information.FEW_SCENES), information.MOST_SCENES)
    found = [best_of(sets, scorer, metric, None, few, most) for sets in by_number]
    for one, sets in zip(found, by_number, strict=True):
        text = f"{metric.name} [{metric.unit}] of {len(sets)} sets of {one.sensors} parts on training scenes"
        values = ", ".join(f"{each.scores[:few].mean():.4g}" for each in sets)
        notes(BackgroundNote(f"{text}, the best by the proxy first: {values}"))
    for line in effects_line(scorer):
        notes(line)
    return found


def _row(one: SetTrial, placed: Sequence[PlacedPart]) -> dict[str, Any]:
    """A set as plain values: its parts by name, its score, and its power and price where all are known."""
    kinds = [placed[member].part for member in one.members]
    sums = {name: [part.value(name) for part in kinds] for name in ("power_w", "price")}
    return {
        "sensors": one.sensors,
        "parts": dict(Counter(part.name for part in kinds)),
        "score": float(one.scores.mean()),
        **{name: None if None in values else sum(values) for name, values in sums.items()},
    }


def _row_text(row: Mapping[str, Any], metric: Metric) -> str:
    names = ", ".join(f"{number} {name}" for name, number in row["parts"].items())
    power, price = (
        f"{word} {'unknown' if row[key] is None else f'{row[key]:.4g}{unit}'}"
        for word, key, unit in (("power", "power_w", " W"), ("price", "price", ""))
    )
    return f"--sensors {row['sensors']}: {names}; {metric.name} {row['score']:.4g} {metric.unit}, {power}, {price}"


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
    # a bare name bounds all its modes together
    kinds += [
        (np.array([one.part.name.split(":")[0] == name for one in placed]).astype(int), np.array([count, own.max]))
        for name, own in wanted.each.items()
        if any(mode.startswith(f"{name}:") for mode in names)
    ]
    mounts = {tuple(place) for rules in constraints.rules for place in rules.origin.mounts_m or ()}
    if mounts:
        place = np.array([one.place for one in placed])
        most = np.full(place.max() + 1, count)
        most[[one.place for one in placed if tuple(one.pose.origin_m.tolist()) in mounts]] = 1
        kinds.append((place, most))
    if constraints.each:
        entry, others = np.array([one.entry for one in placed]), max(count - len(constraints.each), 0)
        kinds.append((entry, np.array([*np.ones(len(constraints.each), dtype=np.intp), others])))
    budgets = []
    if budget.limit_mbps is not None:
        bits = [budget.model.mbps_of_widths(np.diff(one.shape.gate_m), min(one.part.rays, most_rays)) for one in placed]
        budgets.append((np.array(bits), budget.limit_mbps))
    budgets += [(np.array([one.part.value(name) for one in placed]), bound) for name, bound in wanted.sums.values()]
    return SetLimits(count, kinds, budgets)


@phase("candidates")
def proposed(
    parts: Sequence[Part], constraints: Constraints, count: int, samples: Samples, seed: int
) -> list[PlacedPart]:
    """Candidate parts at poses that the constraints allow, for each entry of `each` and for the others.

    Raises:
        InfeasibleError: None keeps the constraints.
    """
    space, generator = samples.space, random_generator(seed, "poses of parts")
    ways = [ways for part in parts if (ways := shapes_of(part, space))]
    if not ways:
        raise InfeasibleError(
            "no part measures within the range of the design space", conflicts=["space.range_m", "parts"]
        )
    numbers: dict[tuple[float, ...], int] = {}
    every = constraints.rules if count > len(constraints.each) else constraints.rules[:-1]
    return [one for rules in every for one in _proposed_for(rules, ways, samples, numbers, generator)]


def _proposed_for(
    rules: SensorRules,
    ways: Sequence[Sequence[PartShape]],
    samples: Samples,
    numbers: dict[tuple[float, ...], int],
    generator: np.random.Generator,
) -> list[PlacedPart]:
    """Candidates that keep the rules of one sensor; `numbers` are those of places."""
    places, axes = _places(rules, samples, generator), Axes.of(samples.space)
    broken = [broken_keys(shapes[0], rules) for shapes in ways]
    kept = [shapes for shapes, keys in zip(ways, broken, strict=True) if not keys]
    if not kept or not len(places):
        keys = sorted(set().union(*broken)) if len(places) else ["origin"]
        raise InfeasibleError(
            f"no part satisfies {', '.join(keys)}",
            conflicts=[*keys, "parts"],
            hint="loosen one of them, or name other parts",
        )
    bounds = bounds_of([rules], samples.space, (0,), interval_factor(DEFAULT_LEVEL))
    placed, points = [], observed_point(samples.resample(MOST_POSES, generator))
    for number, origin in enumerate(places):
        offset = points - origin
        # the middle of what is seen, and parts of it
        looking = np.concatenate([offset.mean(axis=0, keepdims=True), offset[number :: len(places)][1:]])
        azimuth, elevation = angles(looking / np.maximum(np.linalg.norm(looking, axis=1), TINY)[:, None])
        azimuth = clip_azimuth(azimuth, bounds)
        elevation = np.clip(elevation, bounds.elevation_low, bounds.elevation_high)
        # a fixed boresight leaves one of them
        aims = list(dict.fromkeys(zip(azimuth.tolist(), elevation.tolist(), strict=True)))
        place = numbers.setdefault(tuple(origin.tolist()), len(numbers))
        for shapes in kept:
            for turn, shape in enumerate(shapes):
                roll = _roll_of(shape, rules)
                # each way to mount a part has the middle, and its share of the others
                for aim in (aims[0], *aims[1 + turn :: len(shapes)]) if roll is not None else ():
                    pose = shape.pose(origin, *aim, roll, axes)
                    if _may_roll(part_sensor(shape.part, pose), rules):
                        placed.append(PlacedPart(shape, pose, place, rules.index))
    if not placed:
        raise InfeasibleError(
            "no part can be mounted at the roll", conflicts=[rules.path("boresight.roll_deg"), "parts"]
        )
    return placed


def _roll_of(shape: PartShape, rules: SensorRules) -> float | None:
    """The roll of a part nearest to upright, beside that of the way it is mounted [rad]; None where it may not turn."""
    low, high = rules.boresight.roll_deg.min, rules.boresight.roll_deg.max
    upright = 90.0 if shape.turned else 0.0
    roll = float(np.clip(upright, -np.inf if low is None else low, np.inf if high is None else high))
    # a part that is not upright is not turned as well
    return None if shape.turned and roll != upright else np.radians(roll - upright)


def _may_roll(sensor: Sensor, rules: SensorRules) -> bool:
    """True where a sensor keeps the bounds on its roll."""
    low, high = rules.boresight.roll_deg.min, rules.boresight.roll_deg.max
    roll = np.degrees(sensor.roll_rad)
    return (low is None or roll >= low - SLACK) and (high is None or roll <= high + SLACK)


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
    sensors = [
        replace(part_sensor(one.part, one.pose, name=f"s{index}", weight=count / total), gate_m=one.shape.gate_m)
        for index, (one, count) in enumerate(zip(placed, counts, strict=True))
    ]
    fired = [
        replace(
            rays,
            gate_m=np.tile(one.shape.gate_m, (len(rays), 1)),
            sensor=np.full(len(rays), index),
            time_s=np.zeros(len(rays)),
        )
        for index, (one, rays) in enumerate(zip(placed, tables, strict=True))
    ]
    return DesignSpec(
        name=name,
        sensors=tuple(sensors),
        layout="fixed",
        patterns=(Pattern.of(Rays.joined(fired).as_angles()),),
        constraints=constraints.as_document(),
    )
