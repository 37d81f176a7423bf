"""Rays of a fitted design that are chosen on training scenes: `fit --layout selected`.

The density proposes rays inside the sensors; scenes that nothing was learned from say what each of them tells (see
`lidardesign.rays`). Along a condition, as a robot's position, rays are chosen at each of its values that the task
judges at, and become tracks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.errors import check_number
from lidardesign.layouts.density import bandwidth_limit
from lidardesign.layouts.gates import bounded_gates
from lidardesign.layouts.rays import LAYOUTS
from lidardesign.layouts.track import placed, track_of
from lidardesign.mixture.bounds import bounds_of
from lidardesign.mixture.fit import FitResult
from lidardesign.rays import information
from lidardesign.rays.coverage import InformedScene
from lidardesign.rays.gates import CANDIDATES_PER_RAY, gate_choices, sensor_gates
from lidardesign.rays.information import checked_information
from lidardesign.run.clock import phase
from lidardesign.run_folder import Notes, RunFolder, ignore
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.sensor import CERTIFICATES, DesignSpec, Sensor, interval_factor
from lidardesign.space import DIMENSIONS, DesignSpace
from lidardesign.task import random_generator

EVEN_SHARE = 0.25  # of the candidates that are even in the fields, where the density's samples may be sparse
MARGIN_SIGMAS = 2.0  # by which gates are longer than what training scenes returned, in the density's sigma
NEAREST_SHARE = 0.1  # of the samples along a condition that propose rays at one of its values


def select_rays(
    run: RunFolder,
    result: FitResult,
    counts: Sequence[int],
    samples: Samples,
    seed: int,
    first: Mapping[str, Sequence[Scene]],
    *,
    is_trial: bool = False,
    progress: Notes = ignore,
) -> FitResult:
    """The design of a fit with rays that were chosen, one table or track for each number of rays.

    Arguments:
        run: The run, whose task says what returns tell.
        result: The fitted sensors; `gates` of the design says whether rays have gates of their own.
        counts: Numbers of rays, ascending; along a condition, at each of its values.
        samples: Of the density, at all values of its condition.
        seed: Root of the random streams.
        first: The first scenes to choose on, and to hold back, by purpose.
        is_trial: Whether rays are chosen on these alone, without certificates.
        progress: Called with every step.

    Raises:
        ConfigError: More rays than can be chosen.
        DataError: No ray inside the sensors tells anything about the training scenes.
        InfeasibleError: A bandwidth in which no choice of so many rays fits.
    """
    from lidardesign.rays.selection import SelectionProblem, select

    check_number(counts[-1], "--rays", 1, information.MOST_SELECTED)
    spec = result.design
    constraints = Constraints.from_mapping(spec.constraints, where=f"constraints of {spec.name}")
    proposals = Proposals(run, spec, samples, seed)
    candidates = proposals.at_conditions(CANDIDATES_PER_RAY * counts[-1])
    ends = np.cumsum([0, *map(len, candidates)])
    rays, visits = Rays.joined(candidates), [slice(*pair) for pair in itertools.pairwise(ends.tolist())]
    limit = constraints.budget.bandwidth_mbps
    problem = SelectionProblem(
        rays=rays,
        visits=visits,
        shares=spec.weights if len(visits) > 1 else None,
        gates=partial(_gates, spec, constraints, samples.space, gate_margin_m(run)),
        informs=partial(checked_information, run.task),
        scenes=lambda purpose: itertools.chain(
            first[purpose], itertools.islice(selection_scenes(run, seed, purpose), len(first[purpose]), None)
        ),
        # each of a few values of a condition sees little of a scene
        most_scenes=information.MOST_SCENES * (1 + bool(samples.space.conditioned)),
        bandwidth=bandwidth_limit(constraints, len(rays))[0],
        limit_mbps=np.inf if limit is None else limit,
        one_gate=spec.gates != "ray",
        name=spec.name,
        further=None if is_trial or len(visits) > 1 else proposals.further(len(rays)),
        is_trial=is_trial,
        progress=progress,
    )
    selected = select(problem, counts)
    provenance = {**spec.provenance, CERTIFICATES: [one.certificate for one in selected]}
    design = replace(spec, layout="selected", rays=counts[0] if len(counts) == 1 else None, provenance=provenance)
    tables = [one.rays for one in selected]
    fired = tables[-1][0]
    own = [np.flatnonzero(fired.sensor == index) for index in range(len(spec.sensors))]
    sensors = tuple(replace(sensor, rays=len(rows)) for sensor, rows in zip(spec.sensors, own, strict=True))
    idle = [sensor.name for sensor in sensors if not sensor.rays]
    if idle:
        note = f"{', '.join(idle)} need not be built: none of the {counts[-1]} rays starts there"
        result = replace(result, notes=(*result.notes, note))
    if spec.gates != "ray":
        sensors = tuple(
            _with_gate(sensor, fired.gate_m[rows[0]], spec.level) if len(rows) else sensor
            for sensor, rows in zip(sensors, own, strict=True)
        )
    design = replace(design, sensors=sensors)
    if len(visits) == 1:
        return replace(
            result,
            design=replace(design, ray_table=tables[-1][0], further_tables=tuple(one[0] for one in tables[:-1])),
        )
    return replace(result, design=_on_tracks(design, tables, proposals.conditions, samples.space))


def _with_gate(sensor: Sensor, gate_m: np.ndarray, level: float) -> Sensor:
    spread_m = float(gate_m[1] - gate_m[0]) / (2 * interval_factor(level))
    return replace(sensor, range_m=float(gate_m.mean()), spread_range_m=spread_m)


def selection_scenes(run: RunFolder, seed: int, purpose: str) -> Iterator[Scene]:
    """Training scenes that nothing was learned from, without end, drawn with further seeds for each purpose."""
    for draw in itertools.count():
        yield from run.scenes("train", int(random_generator(seed, "selection", purpose, draw).integers(2**31)))


def gate_margin_m(run: RunFolder) -> float:
    """By how much gates are longer at both ends than what training scenes returned [m]."""
    return MARGIN_SIGMAS * run.config.density.sigma_m


def near(samples: Samples, at: Mapping[str, float], share: float = NEAREST_SHARE) -> Samples:
    """The share of samples whose condition is nearest to a value, as if it were there; all without a condition."""
    if not at:
        return samples
    ((name, value),) = at.items()
    axis = DIMENSIONS.index(name)
    away = np.abs(samples.points[:, axis] - value)
    nearest = samples.subset(np.sort(np.argsort(away, kind="stable")[: math.ceil(share * len(samples))]))
    points = nearest.points.copy()
    points[:, axis] = value
    return replace(nearest, points=points, space=samples.space.at(at))


class Proposals:
    """Candidate rays inside the sensors of a design.

    Arguments:
        run: The run of the density.
        spec: The design.
        samples: Of the density.
        seed: Root of the random streams.
    """

    def __init__(self, run: RunFolder, spec: DesignSpec, samples: Samples, seed: int) -> None:
        self.samples, self.seed = samples, seed
        self.conditions = run.conditions(samples.space)
        sensors = tuple(replace(sensor, rays=None) for sensor in spec.sensors)
        self.spec = replace(spec, ray_table=None, rays=None, sensors=sensors)
        # rays start all over the origins of their sensors, where these are left free
        has_extent = any(np.any(sensor.origin_covariance_m2) for sensor in sensors)
        self.layout = "distributed" if has_extent else "density"

    @phase("candidates")
    def at_conditions(self, count: int) -> list[Rays]:
        """So many rays at each value of the condition, most of them where the density is."""
        even = round(EVEN_SHARE * count)
        layouts = ((self.layout, count - even), ("grid", even))
        return [Rays.joined([self._laid_out(*layout, at) for layout in layouts]) for at in self.conditions]

    def further(self, count: int) -> Rays:
        """As many rays again: at random every second one of twice as many, which are elsewhere."""
        (rays,) = self.at_conditions(2 * count)
        return rays.subset(np.sort(random_generator(self.seed, "selection", "further").permutation(2 * count)[:count]))

    def _laid_out(self, layout: str, count: int, at: Mapping[str, float]) -> Rays:
        here = placed(self.spec, at) if at else self.spec
        rays = LAYOUTS[layout].lay_out(here, count, near(self.samples, at), "sensor", self.seed)
        return replace(rays, time_s=np.zeros(count))


@phase("gates")
def _gates(
    spec: DesignSpec,
    constraints: Constraints,
    space: DesignSpace,
    margin_m: float,
    rays: Rays,
    visits: Sequence[slice],
    informed: Sequence[InformedScene],
) -> np.ndarray:
    """The gates that rays may have inside the design's constraints, (N, G, 2) [m]."""
    choices = gate_choices if spec.gates == "ray" else sensor_gates
    gates_m = choices(rays, visits, informed, margin_m)
    for index, sensor in enumerate(spec.sensors):
        own = rays.sensor == index
        wanted = gates_m[own].reshape(-1, 2)
        bounds = bounds_of(constraints.rules, space, (index,), interval_factor(spec.level))
        allowed = bounded_gates(wanted, sensor, bounds.take(np.zeros(len(wanted), dtype=np.int64)))
        gates_m[own] = allowed.reshape(-1, *gates_m.shape[1:])
    return gates_m


def _on_tracks(
    design: DesignSpec,
    tables: Sequence[Sequence[Rays]],
    conditions: Sequence[Mapping[str, float]],
    space: DesignSpace,
) -> DesignSpec:
    """The design with a track of each number of rays, its sensors in the middle of their travel."""
    (dimension,), name = space.conditioned, DIMENSIONS[space.conditioned[0]]
    ends = space.low[dimension], space.high[dimension]
    tracks = [track_of(dimension, [at[name] for at in conditions], one, ends) for one in tables]
    middle = placed(design, {name: sum(ends) / 2})
    covariance = np.zeros((3, 3))
    covariance[dimension, dimension] = ((ends[1] - ends[0]) / (2 * interval_factor(design.level))) ** 2
    sensors = tuple(
        replace(sensor, origin_covariance_m2=sensor.origin_covariance_m2 + covariance) for sensor in middle.sensors
    )
    at = {key: value for key, value in design.at.items() if key != name}
    tracked = replace(design, sensors=sensors, ray_table=None, at=at)
    return replace(tracked, track=tracks[-1], further_tracks=tuple(tracks[:-1]))
