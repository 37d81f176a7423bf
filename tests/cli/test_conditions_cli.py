"""Conditions on the command line: `--at`, patterns that follow a condition, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from support.command_line import caller
from support.conditioned_runs import log_target, make_conditioned_run

from lidardesign.formats.designs import load_design


@pytest.fixture
def lidardesign(capsys, tmp_path, monkeypatch):
    """Run the program in this process; the target density is the planted one."""
    monkeypatch.setattr("lidardesign.fitting.request.RunTarget.__call__", lambda self, points: log_target(points))
    return caller(capsys, tmp_path, monkeypatch)


@pytest.fixture
def run(tmp_path):
    return make_conditioned_run(tmp_path / "run")


@pytest.fixture
def following(lidardesign, run):
    """A design of four rays that follow the condition."""
    result = lidardesign("fit", run, "--sensors", 1, "--rays", 4)
    assert result.code == 0, result.err
    assert "4 rays at every x_m from 0 to 1" in result.out
    return run / "designs" / "fit.yaml"


@pytest.mark.parametrize("layout", ["even", "chosen"])
def test_a_design_is_fitted_at_a_value(lidardesign, run, layout):
    sensors = ("--sensors", 2, "--layout", layout)
    result = lidardesign("fit", run, "--at", "x_m=0.37", *sensors, "--rays", 6, "--name", "here", "--json", "-v")
    assert result.code == 0, result.err
    design = load_design(run / "designs" / "here.yaml")
    assert (design.layout, dict(design.at), design.condition) == (layout, {"x_m": 0.37}, None)
    assert {sensor.origin_m[0] for sensor in design.sensors} == {0.37}
    rays = design.rays(6)
    np.testing.assert_array_equal(rays.origin_m[:, 0], 0.37)
    elsewhere = design.rays(6, at={"x_m": 0.8})
    np.testing.assert_array_equal(elsewhere.direction, rays.direction)
    np.testing.assert_array_equal(elsewhere.gate_m, rays.gate_m)
    # from x = 0.37 the spot lies at 90 + 0.052 rad
    assert abs(np.average(rays.direction[:, 0]) + 0.052) < 0.1
    assert "ESS" in result.err
    assert 0.01 < result.json["ess"] <= 1


def test_the_number_of_sensors_at_a_value_is_found_in_scenes_judged_from_there(lidardesign, run):
    result = lidardesign("fit", run, "--at", "x_m=0.37", "--rays", 6, "-v")
    assert result.code == 0, result.err
    assert "training scenes by their number" in result.err
    assert dict(load_design(run / "designs" / "fit.yaml").at) == {"x_m": 0.37}


def test_rays_follow_a_condition_and_are_shown_at_its_values(lidardesign, following):
    design = load_design(following)
    assert (design.layout, design.condition, design.count) == ("chosen", "x_m", 4)
    shown = lidardesign("show", following)
    assert "--at x_m=VALUE" in shown.out
    (pattern,) = lidardesign("show", following, "--json").json["patterns"]
    assert pattern["dimension"] == "x_m"
    assert len(pattern["azimuth_rad"][0]) == 4
    here = lidardesign("show", following, "--at", "x_m=0.25", "--json").json
    assert "dimension" not in here["patterns"][0]
    assert here["at"] == {"x_m": 0.25}
    rays = design.rays(at={"x_m": 0.25})
    assert here["patterns"][0]["gate_start_m"][0] == pytest.approx(rays.gate_m[:, 0])
    assert "at x_m=0.25" in lidardesign("show", following, "--at", "x_m=0.25").out


def test_rays_along_a_condition_score_the_same_where_their_run_is_gone(lidardesign, following, tmp_path):
    (tmp_path / "away.yaml").write_text(following.read_text().replace("name: fit", "name: away"))
    few = ("--rays", 4, "--set", "test=4", "--baseline", "none")
    result = lidardesign("evaluate", following, "away.yaml", *few, "--json")
    assert result.code == 0, result.err
    rows = {row["design"]: row for row in result.json["rows"]}
    for key in ("value", "bandwidth_mbps", "failures"):
        assert rows["away"][key] == rows["fit"][key]


def test_constraints_hold_along_a_condition_and_at_a_value(lidardesign, run, following):
    rules = ("--set", "gate.width_m.max=0.25", "--set", "budget.bandwidth_mbps=0.04")
    along = lidardesign("constrain", following, *rules, "--name", "along", "--json")
    assert along.code == 0, along.err
    assert along.json["satisfied"] is True
    (pattern,) = load_design(run / "designs" / "along.yaml").patterns
    assert np.diff(pattern.gate_m, axis=2).max() <= 0.25 + 1e-12
    here = lidardesign("constrain", following, *rules, "--at", "x_m=0.6", "--name", "here", "--json")
    assert here.code == 0, here.err
    assert dict(load_design(run / "designs" / "here.yaml").at) == {"x_m": 0.6}
    # a design for one value stays for that value unless another one is given
    assert lidardesign("constrain", run / "designs" / "here.yaml", "--name", "again").code == 0
    assert dict(load_design(run / "designs" / "again.yaml").at) == {"x_m": 0.6}
    assert lidardesign("constrain", run / "designs" / "here.yaml", "--at", "x_m=0.5", "--name", "moved").code == 0
    assert dict(load_design(run / "designs" / "moved.yaml").at) == {"x_m": 0.5}


def test_rays_that_follow_a_condition_are_exported_at_a_position(lidardesign, following, tmp_path):
    result = lidardesign("export", following, "--format", "npz", "--at", "x_m=0.25", "--out", "r.npz")
    assert result.code == 0, result.err
    expected = load_design(following).rays(at={"x_m": 0.25})
    with np.load(tmp_path / "r.npz") as arrays:
        np.testing.assert_array_equal(arrays["origin_x_m"], 0.25)
        np.testing.assert_array_equal(arrays["gate_start_m"], expected.gate_m[:, 0])
        np.testing.assert_allclose(arrays["elevation_rad"], expected.elevation_rad, atol=1e-12)
    assert lidardesign("export", following, "--format", "sensors-csv", "--at", "x_m=0.25", "--out", "s.csv").code == 0
    for further, words in (((), "x_m from 0 to 1"), (("--at", "x_m=2"), "0 to 1")):
        refused = lidardesign("export", following, "--format", "csv", *further)
        assert refused.code == 2
        assert words in refused.err


def test_several_conditions_are_given_at_once(lidardesign, tmp_path):
    run = make_conditioned_run(tmp_path / "two", 10_000, "[x_m,azimuth_rad]")
    given = ("--at", "x_m=0.5", "--at", "azimuth_rad=1.6", "--layout", "even", "--sensors", 1)
    result = lidardesign("fit", run, *given, "--json")
    assert result.code == 0, result.err
    (sensor,) = json.loads(result.out)["sensors"]
    assert sensor["boresight"]["azimuth_rad"] == pytest.approx(1.6)
    assert sensor["field_of_view_rad"]["horizontal"] == 0
    assert np.mean(list(sensor["gate_m"].values())) == pytest.approx(0.6, abs=0.02)
