"""How tight constraints are follows from the checker's findings, sensor by sensor, and is told once per bound."""

from __future__ import annotations

import pytest

from lidardesign.constraints.check import ConstraintCheck
from lidardesign.constraints.slack import constraint_slack, room_of


def check(name, bound, value, satisfied=True):
    return ConstraintCheck(name, bound, value, satisfied)


@pytest.mark.parametrize(
    ("found", "room", "share"),
    [
        (check("a.gate.width_m.max", 0.2, 0.15), 0.05, 0.25),
        (check("a.gate.start_m.min", 0.1, 0.4), 0.3, 3.0),
        (check("budget.bandwidth_mbps", 2.0, 2.5, False), -0.5, -0.25),
        (check("a.origin.high_m", [1.0, 2.0, 4.0], [0.5, 1.9, 0.0]), 0.1, 0.05),
        (check("a.space.range_m", [0.0, 2.0], [0.5, 1.9]), 0.1, 0.05),
        (check("a.boresight.azimuth_deg", [350.0, 30.0], 5.0), 15.0, 0.375),
        (check("a.boresight.azimuth_deg", [350.0, 30.0], 345.0, False), -5.0, -0.125),
        (check("a.part", "part", "part"), None, None),
        (check("a.field_of_view.horizontal_deg.min", 0.0, 3.0), 3.0, None),
    ],
)
def test_room_is_the_distance_to_the_bound_and_its_share(found, room, share):
    assert room_of(found) == (pytest.approx(room), pytest.approx(share))


def test_a_bound_of_many_sensors_is_told_once_by_the_closest():
    names = ["s", "s.1", "s2"]
    found = [
        check(f"{name}.gate.width_m.max", 0.1, width) for name, width in zip(names, (0.05, 0.0999, 0.08), strict=True)
    ]
    (told,) = constraint_slack(found, names)
    assert (told.name, told.sensor, told.sensors, told.tight, told.broken) == ("gate.width_m.max", "s.1", 3, 1, 0)
    assert told.value == 0.0999
    assert told.word == "at the bound"


def test_sensors_with_bounds_of_their_own_are_told_apart_and_broken_ones_come_first():
    found = [check("a.gate.end_m.max", 1.0, 0.2), check("b.gate.end_m.max", 2.0, 2.5, False)]
    found.append(check("c.gate.end_m.max", 2.0, 0.1))
    loose, broken = constraint_slack(found, ["a", "b", "c"])
    assert (loose.word, loose.room) == ("kept", pytest.approx(0.8))
    assert (broken.word, broken.sensor, broken.broken, broken.sensors) == ("broken", "b", 1, 2)
    assert broken.room == pytest.approx(-0.5)
