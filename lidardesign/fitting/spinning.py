"""The layout `spinning`: spinning sensors whose places and channel elevations are chosen on training scenes.

A candidate is a ring: the rays of one turn from one place at one elevation. Sensors stand upright. The information of a
ring is that of its rays together (`Coverage.grouped`), so rings are chosen as rays are, and with the same certificate.
Every set of places is tried, and at each of its places as many rings are chosen as a sensor has channels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from time import perf_counter

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.constraints.origins import inside_excluded, mounts_of, origin_box
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.fitting.options import refuse_first
from lidardesign.fitting.result import FitResult
from lidardesign.numerics import FULL_TURN
from lidardesign.rays import information
from lidardesign.rays.certificate import certificate_document, certify
from lidardesign.rays.choice import Choice, RayCounts, choose
from lidardesign.rays.coverage import Coverage, gather
from lidardesign.rays.proposals import CANDIDATES_PER_RAY
from lidardesign.rays.training_scenes import Informs, information_of
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import MOST_FILE_RAYS
from lidardesign.sensors.pattern import Pattern
from lidardesign.sensors.sensor import Sensor
from lidardesign.space import DesignSpace

CHANNELS = 16  # of a sensor by default
POINTS_PER_TURN = 1800  # of a channel: every fifth of a degree, as scanners do at ten turns per second
EVEN_SHARE = 0.25  # of candidate elevations that are even; the others are denser where even ones gain most
FIRST_SHARE = 0.2  # of the scenes, for these gains
PLACES = np.array([(0.5, 0.5, 0.5), (0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 0)])  # in a box, no corners on one edge
MOST_SETS, MOST_BOUNDED = 500, 20  # of places: that are tried, and that are bounded one by one


@dataclass(frozen=True, eq=False)
class RingCandidates:
    """Candidate rings: every place with every elevation.

    Arguments:
        places_m: Possible places of sensors, (P, 3) [m].
        elevation_rad: Ascending, (E,).
        points: Rays of a ring.
        range_m: Start and end of their gates [m].
    """

    places_m: np.ndarray
    elevation_rad: np.ndarray
    points: int
    range_m: tuple[float, float]

    def __len__(self) -> int:
        return len(self.places_m) * len(self.elevation_rad)

    @cached_property
    def place(self) -> np.ndarray:
        """The place of each ring, (P E,)."""
        return np.repeat(np.arange(len(self.places_m)), len(self.elevation_rad))

    def rays(self, rings: np.ndarray, sensor: np.ndarray) -> Rays:
        """The rays of some rings, each assigned to a sensor, fired column by column as the head turns."""
        turn = np.tile(FULL_TURN * ((np.arange(self.points) + 0.5) / self.points - 0.5), len(rings))
        column, ring = np.tile(np.arange(self.points), len(rings)), np.repeat(rings, self.points)
        order = np.lexsort((ring, column, np.repeat(sensor, self.points)))
        ring = ring[order]
        return Rays.from_angles(
            self.places_m[self.place[ring]],
            turn[order],
            self.elevation_rad[ring % len(self.elevation_rad)],
            np.tile(self.range_m, (len(ring), 1)),
            np.repeat(sensor, self.points)[order],
        )

    def coverage(
        self,
        rings: np.ndarray,
        scenes: Iterator[Scene],
        informs: Informs,
        share: float,
        scenes_share: float = 1.0,
    ) -> tuple[Coverage, str]:
        """Information of some rings, of which a share will be chosen, about `FEW_SCENES` scenes, and its unit."""
        rays = self.rays(rings, np.arange(len(rings)))
        few = itertools.islice(scenes, round(scenes_share * information.FEW_SCENES))
        informed = [information_of(scene, rays, [slice(0, len(rays))], informs, share) for scene in few]
        table = gather(informed, rays.gate_m[:, None], np.zeros((len(rays), 1)))
        return table.grouped(np.arange(len(rays)).reshape(len(rings), self.points)), informed[0].unit


def choose_rings(
    samples: Samples,
    constraints: Constraints,
    *,
    count: int,
    channels: int,
    rays: int | None,
    informs: Informs,
    scenes: Callable[[str], Iterator[Scene]],
    name: str,
) -> FitResult:
    """The design of a few spinning sensors with the best channels at the best places.

    Arguments:
        samples: Of the density, whose design space says where rays may start and look.
        constraints: Places of sensors and further constraints.
        count: Number of sensors.
        channels: Rings of each.
        rays: Of all sensors per turn; None fires `POINTS_PER_TURN` for each channel, or what a file holds.
        informs: The task's information of a scene's returns.
        scenes: An endless stream of training scenes for a purpose, `choice` or `held back`.
        name: The design's name.

    Raises:
        ConfigError: Rays that rings cannot share, more channels than elevations, more sets of places than can be
            tried, or a density with conditions.
        InfeasibleError: Constraints that contradict each other, or no ring has information about the scenes.
    """
    started, space, rings = perf_counter(), samples.space, count * max(channels, 1)
    check_feasible(constraints, space, sensors=count, rays=rays)
    even, points = ring_grid(space, rays, count, channels)
    first = RingCandidates(places_of(constraints, space), even, points, (space.low[5], space.high[5]))
    elevations = len(even)
    every, share = np.arange(len(first)), rings / len(first)
    with phase("what returns tell"):
        told, _ = first.coverage(every, scenes("choice"), informs, share, FIRST_SHARE)
        if not len(told.item):
            raise InfeasibleError(f"none of {len(first)} rings has information about the training scenes", where=name)
        gains = told.gains(np.zeros(len(told.weight)))[:, 0].reshape(-1, elevations).sum(axis=0)
        candidates = replace(first, elevation_rad=refine_elevations(even, gains))
        coverage, unit = candidates.coverage(every, scenes("choice"), informs, share)
    with phase("choice"):
        choice, loss, bound = chosen_rings(coverage, candidates.place, count, channels)
    chosen = choice.rays
    with phase("what returns tell"):
        judged, _ = candidates.coverage(chosen, scenes("held back"), informs, 1.0)
    places, sensor = np.unique(candidates.place[chosen], return_inverse=True)
    table = candidates.rays(chosen, sensor)
    certificate = certificate_document(
        rays=len(table),
        value=loss,
        bound=bound,
        held_back_value=judged.loss_of(np.zeros(len(chosen), dtype=np.intp)),
        candidates=len(candidates),
        gates=1,
        scenes=information.FEW_SCENES,
        unit=unit,
    )
    reached = np.abs(candidates.elevation_rad[chosen % elevations])
    design = DesignSpec(
        name=name,
        # upright, looking along +x over a full turn, as a part does (see `part_sensor`)
        sensors=tuple(
            Sensor(
                name=f"s{number}",
                weight=1 / count,
                origin_m=candidates.places_m[place],
                azimuth_rad=0.0,
                elevation_rad=0.0,
                roll_rad=0.0,
                # as far up as down: so its own upright axis is that of its rings
                field_of_view_rad=(FULL_TURN, 2 * float(reached[sensor == number].max())),
                gate_m=candidates.range_m,
            )
            for number, place in enumerate(places)
        ),
        layout="spinning",
        patterns=(Pattern.of(table),),
        constraints=constraints.as_document(),
        certificates=(certificate,),
        provenance={"channels": channels},
    )
    return FitResult(design, None, None, samples.effective_sample_size, perf_counter() - started)


def ring_grid(space: DesignSpace, rays: int | None, count: int, channels: int) -> tuple[np.ndarray, int]:
    """The even elevations of candidate rings, ascending [rad], and the number of rays of a ring.

    Raises:
        ConfigError: An invalid number of channels, rays that rings cannot share equally, or conditions.
    """
    rings = count * max(channels, 1)
    points = min(POINTS_PER_TURN, MOST_FILE_RAYS // rings) if rays is None else rays // rings
    even = np.unique(np.linspace(space.low[4], space.high[4], CANDIDATES_PER_RAY * max(channels, 1)))
    most = min(len(even), MOST_FILE_RAYS // count)
    faults = {
        ("the density has conditions", "--layout spinning", "tasks whose sensors do not move"): space.conditioned,
        (f"{channels} channels", "--channels", f"1 to {most}, of as many elevations and rays as there are"): not (
            1 <= channels <= most
        ),
        (
            f"{rays} rays of {count} sensors with {channels} channels",
            "--rays",
            f"a multiple of {rings}, at most {MOST_FILE_RAYS}: as many for each channel",
        ): points * rings != (rays or points * rings) or not 0 < points * rings <= MOST_FILE_RAYS,
    }
    refuse_first(faults)
    return even, points


def places_of(constraints: Constraints, space: DesignSpace) -> np.ndarray:
    """Candidate places of spinning sensors, (P, 3) [m]: all mounts, or the middle and corners of the origin box."""
    rules = constraints.rules[-1]
    if rules.origin.mounts_m:
        return np.array(mounts_of(rules), dtype=np.float64).reshape(-1, 3)
    low, high = origin_box(rules, space)
    places = low + (high - low) * PLACES
    return np.unique(places[~inside_excluded(places, rules)], axis=0)


def refine_elevations(elevation_rad: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Refined elevations (E,) [rad]: a share even, the rest with a density in proportion to the gains (E,)."""
    count = len(elevation_rad)
    even = math.ceil(EVEN_SHARE * count)
    reached = np.cumsum(gains) / gains.sum()
    wanted = (np.arange(count - even) + 0.5) / (count - even)
    return np.sort(
        np.append(np.linspace(elevation_rad[0], elevation_rad[-1], even), np.interp(wanted, reached, elevation_rad))
    )


def chosen_rings(coverage: Coverage, place: np.ndarray, count: int, channels: int) -> tuple[Choice, float, float]:
    """The best rings found at `count` places, their loss, and a lower bound of the loss of any others.

    Arguments:
        coverage: The information of the rings.
        place: The place of each, (N,).
        count: Number of sensors.
        channels: Rings of each.

    Raises:
        ConfigError: Fewer places than sensors, or too many sets of places.
    """
    places = int(place.max()) + 1
    sets = [
        RayCounts(place, np.where(np.isin(np.arange(places), chosen), channels, 0))
        for chosen in itertools.islice(itertools.combinations(range(places), count), MOST_SETS + 1)
    ]
    if not 1 <= len(sets) <= MOST_SETS:
        raise ConfigError(
            f"{count} spinning sensors at {places} places", where="--sensors",
            allowed=f"at most {places} sensors, and {MOST_SETS} sets of places", hint="fewer mounts, or fewer sensors",
        )  # fmt: skip

    def gained(counts: RayCounts) -> float:
        found = choose(coverage, counts, passes=0)
        return found.worth - found.harm

    best = choose(coverage, max(sets, key=gained) if len(sets) > 1 else sets[0])
    # all rings of all places together lose no more than those of the best places
    bounded = sets if len(sets) <= MOST_BOUNDED else [RayCounts.of_one(len(place), count * channels)]
    gain = max(certify(coverage, counts, best)[1] for counts in bounded)
    loss = coverage.complete - (best.worth - best.harm)
    return best, loss, float(np.clip(coverage.complete - gain, 0.0, loss))
