"""Sensors at mounting points: how many fit, which mounts are taken, and that what is written sits at them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.constraints.origins import most_mounted, mounts_suffice
from lidardesign.errors import InfeasibleError
from lidardesign.mixture.fit import FitProblem, fit_sensors
from lidardesign.samples import Samples
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.space import DesignSpace, aim, observed_point

ROOM = DesignSpace((-2, -2, 0, 0.0, -math.pi / 2, 0.05), (2, 2, 2, 2 * math.pi, math.pi / 2, 6.0))
NEAR, FAR = np.array([-1.0, 0.0, 0.5]), np.array([1.0, 0.0, 0.5])
WIDTH = 0.05
# Two mounts on either side of each of two blobs that a wall at x = 0 keeps apart; the first two are close.
MOUNTS = [[-1.5, 0.0, 1.0], [-1.5, 0.1, 1.0], [1.5, 0.0, 1.0], [1.4, 0.4, 1.2]]


def log_target(points):
    """Two blobs of scene points, each seen from its own half of the room only."""
    scene, side = observed_point(points), np.sign(points[:, 0])
    blobs = [np.square((scene - centre) / WIDTH).sum(axis=-1) for centre in (NEAR, FAR)]
    return np.where(side < 0, -0.5 * blobs[0], -0.5 * blobs[1])


def room(count=12_000, seed=0):
    """Samples of the density of two blobs, two thirds of it in the near one."""
    generator = np.random.default_rng(seed)
    near = generator.uniform(size=count) < 2 / 3
    scene = np.where(near[:, None], NEAR, FAR) + WIDTH * generator.standard_normal((count, 3))
    origin = generator.uniform([0.0, -2, 0], [2, 2, 2], (count, 3))
    origin[near, 0] *= -1
    points = aim(origin, scene)
    target = log_target(points)
    return Samples(points, target + 2 * np.log(points[:, 5]) + np.log(np.where(near, 2, 1)), target, ROOM)


SAMPLES = room()


def fitted(**values):
    """Sensors under constraints, which they keep as written too."""
    problem = FitProblem(
        samples=SAMPLES, constraints=Constraints.from_mapping(values), retarget=log_target, em_samples=3000, restarts=2
    )
    sensors = fit_sensors(problem).sensors
    assert all(check.satisfied for check in check_design(design_document(DesignSpec("d", sensors)), values, ROOM))
    return sensors


def places(sensors):
    return sorted(tuple(sensor.origin_m) for sensor in sensors)


def test_every_mount_has_one_sensor_where_no_number_is_asked_for():
    sensors = fitted(origin={"mounts_m": MOUNTS})
    assert places(sensors) == sorted(map(tuple, MOUNTS))
    assert all(sensor.origin_covariance_m2 is None for sensor in sensors)


def test_fewer_sensors_take_the_mounts_that_see_most_together():
    chosen = places(fitted(sensors={"count": 2}, origin={"mounts_m": MOUNTS}))
    assert chosen[0][0] < 0 < chosen[1][0]


def test_the_order_of_the_mounts_does_not_matter():
    first, *others = [
        places(fitted(sensors={"count": 2}, origin={"mounts_m": list(order)}))
        for order in itertools.islice(itertools.permutations(MOUNTS), 0, 24, 9)
    ]
    assert all(other == first for other in others)


def test_each_sensor_keeps_its_own_gate_at_its_mount():
    gates = [{"gate": {"width_m": {"max": 0.1}}}, {}]
    start, end = fitted(origin={"mounts_m": MOUNTS}, sensors={"count": 2}, each=gates)[0].gate_m
    assert end - start <= 0.1


@pytest.mark.parametrize(
    ("values", "conflicts"),
    [
        ({"sensors": {"count": 5}, "origin": {"mounts_m": MOUNTS}}, ["sensors.count", "origin.mounts_m"]),
        ({"sensors": {"min": 5}, "origin": {"mounts_m": MOUNTS}}, ["sensors.min", "origin.mounts_m"]),
        ({"origin": {"mounts_m": [[0, 0, 1], [3, 0, 0]]}}, ["origin.mounts_m[1]", "space.x_m"]),
        ({"origin": {"mounts_m": [[0, 0, 1]], "fixed_m": [0, 0, 1]}}, ["origin.fixed_m", "origin.mounts_m"]),
        ({"origin": {"mounts_m": [[0, 0, 1]], "high_m": [0, 0, 0.5]}}, ["origin.mounts_m[0]", "origin.high_m"]),
        (
            {"each": [{"origin": {"mounts_m": [[0, 0, 1]]}}, {"origin": {"mounts_m": [[0, 0, 1]]}}]},
            ["each", "each[0].origin.mounts_m", "each[1].origin.mounts_m"],
        ),
    ],
)
def test_mounts_that_contradict_other_constraints_are_refused_by_name(values, conflicts):
    with pytest.raises(InfeasibleError) as caught:
        fitted(**values)
    assert sorted(caught.value.conflicts) == sorted(conflicts)


def test_mounts_that_see_nothing_are_refused():
    with pytest.raises(InfeasibleError, match="no mount sees"):
        fitted(sensors={"count": 1}, origin={"mounts_m": [[0, 2, 0], [0, -2, 0]]}, gate={"end_m": {"max": 0.2}})


def test_the_checker_finds_sensors_that_left_or_share_a_mount():
    rules = {"origin": {"mounts_m": MOUNTS}}
    document = design_document(DesignSpec("d", fitted(sensors={"count": 2}, **rules)))
    first, second = (sensor["origin_m"] for sensor in document["sensors"])

    def failed():
        return [check.name for check in check_design(document, rules) if not check.satisfied]

    assert failed() == []
    first["mean"][0] += 1e-6
    assert failed() == ["s0.origin.mounts_m"]
    first["mean"] = list(second["mean"])
    assert failed() == ["s1.origin.mounts_m"]
    first["mean"], second["mean"] = list(MOUNTS[1]), list(MOUNTS[0])
    first["covariance"] = [[1e-6, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert failed() == ["s0.origin.mounts_m"]


@given(st.lists(st.lists(st.integers(0, 4), min_size=1, max_size=4, unique=True), max_size=5))
def test_a_matching_is_found_exactly_where_one_exists(options):
    mounts = [[(float(i), 0.0, 0.0) for i in own] for own in options]
    exists = any(len(set(pick)) == len(pick) for pick in itertools.product(*options))
    assert mounts_suffice(mounts) == exists


def test_the_number_of_sensors_is_limited_only_where_all_of_them_are_mounted():
    assert most_mounted(Constraints.from_mapping({}).rules) is None
    assert most_mounted(Constraints.from_mapping({"each": [{"origin": {"mounts_m": MOUNTS}}, {}]}).rules) is None
    assert most_mounted(Constraints.from_mapping({"origin": {"mounts_m": MOUNTS}}).rules) == 4
    shared = {"origin": {"mounts_m": MOUNTS}, "each": [{"origin": {"mounts_m": [MOUNTS[0]]}}]}
    assert most_mounted(Constraints.from_mapping(shared).rules) == 4


def test_a_sensor_with_one_mount_keeps_it_though_another_would_see_more_from_there():
    best, other = MOUNTS[0], MOUNTS[2]
    each = [{"origin": {"mounts_m": [best, other]}}, {"origin": {"mounts_m": [best]}}]
    assert [tuple(sensor.origin_m) for sensor in fitted(sensors={"count": 2}, each=each)] == [tuple(other), tuple(best)]
