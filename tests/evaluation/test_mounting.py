"""`evaluate --mount-error`: sensors that are misplaced, all by the same hands, and what that costs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.command_line import make_run
from support.scoring import design, make_request, rows_by_key, scenes
from support.workers import random_rays

from lidardesign.api.run import open_run
from lidardesign.errors import ConfigError
from lidardesign.estimates import paired_difference
from lidardesign.evaluation.mounting import MountError
from lidardesign.evaluation.score import evaluate
from lidardesign.evaluation.seeds import over_seeds
from lidardesign.report.sections import mounting_section

DEGREE = math.pi / 180
ERROR = MountError(0.005, 0.5 * DEGREE)
NONE = MountError(0.0, 0.0)


def rays_of(sensors, seed=0):
    return replace(random_rays(len(sensors), seed), sensor=np.asarray(sensors))


@pytest.mark.parametrize(
    ("text", "place_m", "angle_rad"),
    [
        ("5mm,0.5deg", 0.005, 0.5 * DEGREE),
        (" 0.5 deg , 5 mm ", 0.005, 0.5 * DEGREE),
        ("2cm", 0.02, 0.0),
        ("3mrad", 0.0, 0.003),
        ("0.1m,0.02rad", 0.1, 0.02),
        ("1e2mm,0deg", 0.1, 0.0),
    ],
)
def test_errors_are_read_in_their_units(text, place_m, angle_rad):
    assert MountError.parse(text) == MountError(pytest.approx(place_m), pytest.approx(angle_rad))


@pytest.mark.parametrize(
    "text", ["", "5", "5 miles", "mm", "-1mm", "nan mm", "5mm,6mm", "1deg,2rad", "5mm 1deg", "200deg", "1e99m"]
)
def test_what_is_no_error_is_refused_with_what_is(text):
    with pytest.raises(ConfigError, match="--mount-error") as caught:
        MountError.parse(text)
    assert "5mm,0.5deg" in caught.value.hint


def test_a_sensor_is_turned_about_its_own_middle_and_shifted_as_one_body():
    rays = rays_of([0, 0, 0, 2, 2, 1])
    (moved,) = ERROR.misplaced((rays,), 1, 4)
    assert (moved.gate_m.tolist(), moved.time_s.tolist()) == (rays.gate_m.tolist(), rays.time_s.tolist())
    for sensor in range(3):
        own = rays.sensor == sensor
        before, after = rays.origin_m[own], moved.origin_m[own]
        # a rigid motion that turns places and directions alike
        turn, rest = Rotation.align_vectors(moved.direction[own], rays.direction[own])
        if own.sum() > 1:
            assert rest == pytest.approx(0.0, abs=1e-7)
            around = (before - before.mean(axis=0)) @ turn.as_matrix().T + after.mean(axis=0)
            np.testing.assert_allclose(after, around, atol=1e-9)
        assert np.linalg.norm(after.mean(axis=0) - before.mean(axis=0)) < 6 * 0.005


def test_errors_have_the_standard_deviations_that_were_asked_for():
    rays = rays_of(np.arange(3000))
    (moved,) = ERROR.misplaced((rays,), 0, 0)
    shift = moved.origin_m - rays.origin_m
    np.testing.assert_allclose(shift.std(axis=0), 0.005, rtol=0.05)
    turned = np.linalg.norm(moved.direction - rays.direction, axis=1)
    # of a rotation vector only what is across a ray turns it: two of three axes
    assert np.sqrt((turned**2).mean()) == pytest.approx(0.5 * DEGREE * math.sqrt(2), rel=0.05)


def test_all_designs_are_mounted_by_the_same_hands():
    few, many = rays_of([0, 1]), rays_of([0, 1, 2, 2, 5], seed=1)
    (first,), (second,) = ERROR.misplaced((few,), 3, 1), ERROR.misplaced((many,), 3, 1)
    shifts = [first.origin_m[:2] - few.origin_m[:2], second.origin_m[:2] - many.origin_m[:2]]
    np.testing.assert_allclose(*shifts, atol=1e-12)
    here, there = ERROR.misplaced((few, few), 3, 1)
    assert here.origin_m.tobytes() == there.origin_m.tobytes()
    for seed, scene in ((3, 2), (4, 1)):
        assert ERROR.misplaced((few,), seed, scene)[0].origin_m.tobytes() != first.origin_m.tobytes()


def test_without_an_error_or_rays_nothing_moves():
    rays = rays_of([0, 0, 3])
    (same,) = NONE.misplaced((rays,), 0, 0)
    np.testing.assert_allclose(same.origin_m, rays.origin_m, atol=1e-12)
    np.testing.assert_allclose(same.direction, rays.direction, atol=1e-12)
    empty = rays.subset(np.zeros(3, dtype=bool))
    assert len(ERROR.misplaced((empty,), 0, 0)[0]) == 0


def test_every_row_stands_beside_itself_mounted_exactly():
    exact = evaluate(make_request())
    evaluation = evaluate(make_request(mount_error=MountError(0.0, 3 * DEGREE)))
    assert exact.mounting is None
    assert "mounting" not in exact.as_dict()
    for row, plain in zip(evaluation.rows, exact.rows, strict=True):
        assert row.per_scene.tolist() == plain.per_scene.tolist()
    mounting = evaluation.mounting
    assert [(row.design, row.rays) for row in mounting.rows] == [(row.design, row.rays) for row in exact.rows]
    rows = rows_by_key(exact)
    for row, cost in zip(mounting.rows, mounting.costs, strict=True):
        own = rows[row.design, row.rays]
        found = paired_difference(row.per_scene, own.per_scene, own.groups, limits=exact.metric.limits)
        assert (cost.difference, cost.ci_low, cost.ci_high) == pytest.approx(found)
        assert cost.difference == pytest.approx(row.value - own.value)
    # an aimed pencil of rays suffers; rays in all directions do not mind
    costs = {(cost.a, cost.rays): cost.difference for cost in mounting.costs}
    assert costs["aimed", 25] > abs(costs["random", 25])
    page = mounting_section(evaluation)
    assert "0 mm and 3 degrees" in page
    assert not mounting_section(exact)


def test_over_seeds_rows_and_costs_are_means():
    requests = [
        make_request([design("own", azimuth=0.02 * seed)], seed=seed, mount_error=ERROR, test=scenes(2))
        for seed in range(3)
    ]
    single = [evaluate(request) for request in requests]
    joint = over_seeds(single, (0, 1, 2), 7)
    for number, (row, cost) in enumerate(zip(joint.mounting.rows, joint.mounting.costs, strict=True)):
        assert row.value == pytest.approx(np.mean([each.mounting.rows[number].value for each in single]))
        assert cost.difference == pytest.approx(np.mean([each.mounting.costs[number].difference for each in single]))
    assert over_seeds([replace(each, mounting=None) for each in single], (0, 1, 2), 7).mounting is None


def test_the_command_shows_what_mounting_errors_cost(lidardesign, tmp_path):
    run = make_run(tmp_path / "run", count=1000)
    open_run(run).fit(layout="even", sensors=2, name="two").save()
    options = ("evaluate", run, "--rays", 16, "--set", "test=2", "--baseline", "uniform", "--mount-error")
    mounting = lidardesign(*options, "5mm,0.5deg", "--json").json["mounting"]
    assert (mounting["place_m"], mounting["angle_rad"]) == pytest.approx((0.005, 0.5 * DEGREE))
    assert mounting["rows"][0]["design"] == "two"
    assert "off by 5 mm" in lidardesign(*options, "5mm").out
