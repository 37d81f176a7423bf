"""The level of intervals: a higher one widens fields and gates, and is what a design's file says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.designs import SPACE, drawn_from, three_sensors
from support.fits import fitted

from lidardesign.formats.designs import load_design
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.sensor import interval_factor

LEVELS = (0.8, 0.95, 0.99)
HERE = (0.1, -0.2, 0.3)
SAMPLES = replace(
    drawn_from(DesignSpec("d", three_sensors(origin_m=HERE)), 12_000),
    space=replace(SPACE, low=(*HERE, *SPACE.low[3:]), high=(*HERE, *SPACE.high[3:])),
)


def test_fields_and_gates_hold_as_many_standard_deviations_as_the_level_says():
    found = [fitted(SAMPLES, sensors=3, level=level, em_samples=4000).sensors for level in LEVELS]
    for level, sensors in zip(LEVELS, found, strict=True):
        factor = interval_factor(level) / interval_factor(LEVELS[0])
        for one, narrow in zip(sensors, found[0], strict=True):
            np.testing.assert_allclose(one.field_of_view_rad, factor * np.array(narrow.field_of_view_rad), rtol=1e-6)
            assert np.ptp(one.gate_m) == pytest.approx(factor * np.ptp(narrow.gate_m), rel=1e-6)
            assert np.mean(one.gate_m) == pytest.approx(np.mean(narrow.gate_m))


def gates_in(path):
    design = load_design(Path(path))
    gates = [sensor.gate_m for sensor in design.sensors]
    return design.level, np.diff(np.asarray(gates), axis=1).mean()


def test_fit_and_constrain_take_the_level_and_a_design_that_is_constrained_keeps_it(lidardesign, flat):
    found = []
    for command, level in (("fit", 0.7), ("constrain", 0.7), ("fit", 0.97)):
        options = ("--layout", "even", "--rays", 12, "--sensors", 1, "--level", level)
        result = lidardesign(command, flat, *options, "--json")
        assert result.code == 0, result.err
        found.append(gates_in(result.json["design"]))
        assert found[-1][0] == level
    assert found[0] == found[1]
    assert found[0][1] < found[2][1]
    kept = lidardesign("constrain", flat / "designs" / "fit.yaml", "--json")
    assert gates_in(kept.json["design"])[0] == 0.97


@pytest.mark.parametrize("level", ["0", "1", "nan", "0.9999999"])
@pytest.mark.parametrize("command", ["fit", "constrain"])
def test_a_level_that_holds_nothing_or_everything_is_refused(lidardesign, made, command, level):
    result = lidardesign(command, made, "--level", level)
    assert result.code == 2
    assert "--level" in result.err
