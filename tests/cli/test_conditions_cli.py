"""Conditions on the command line: --at, tracks, and what they refuse."""

from __future__ import annotations

import json

import numpy as np
import pytest
from lidardesign.layouts.rays import lay_out
from support.command_line import caller, files_under, make_run
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


@pytest.mark.parametrize("layout", ["grid", "density", "scan", "distributed"])
def test_every_layout_can_be_fitted_at_a_value(lidardesign, run, layout):
    sensors = () if layout == "scan" else ("--sensors", 2)
    result = lidardesign(
        "fit", run, "--at", "x_m=0.37", "--layout", layout, "--rays", 6, *sensors, "--name", "here", "--json", "-v"
    )
    assert result.code == 0, result.err
    design = load_design(run / "designs" / "here.yaml")
    assert dict(design.at) == {"x_m": 0.37}
    assert design.track is None
    assert {sensor.origin_m[0] for sensor in design.sensors} == {0.37}
    rays = lay_out(design)
    np.testing.assert_array_equal(rays.origin_m[:, 0], 0.37)
    # from x = 0.37 the spot lies at 90 + 0.052 rad
    assert abs(np.average(rays.direction[:, 0]) + 0.052) < 0.06
    assert "ESS" in result.err
    assert 0.01 < result.json["ess"] <= 1


def test_a_scan_without_a_value_is_a_track_and_shown_as_one(lidardesign, run):
    result = lidardesign("fit", run, "--layout", "scan", "--rays", 4)
    assert result.code == 0, result.err
    assert "4 rays at every x_m from 0 to 1" in result.out
    path = run / "designs" / "fit.yaml"
    shown = lidardesign("show", path)
    assert "travel 1 m" in shown.out
    assert "--at x_m=VALUE" in shown.out
    document = lidardesign("show", path, "--json").json
    assert document["track"]["dimension"] == "x_m"
    assert len(document["track"]["azimuth_rad"][0]) == 4
    here = lidardesign("show", path, "--at", "x_m=0.25", "--json").json
    assert here["track"] is None
    assert here["at"] == {"x_m": 0.25}
    rays = lay_out(load_design(path), at={"x_m": 0.25})
    assert [s["gate_m"]["start"] for s in here["sensors"]] == pytest.approx(rays.gate_m[:, 0])
    assert "at x_m=0.25" in lidardesign("show", path, "--at", "x_m=0.25").out


def test_without_a_layout_rays_are_chosen_along_the_condition(lidardesign, run):
    result = lidardesign("fit", run, "--sensors", 1, "--rays", 4)
    assert result.code == 0, result.err
    design = load_design(run / "designs" / "fit.yaml")
    assert design.layout == "selected"
    assert len(design.track.azimuth_rad[0]) == design.rays == 4


@pytest.mark.parametrize(
    ("arguments", "layout"),
    [("--weight variation=1.5", "scan"), ("--at x_m=0.37", "scan"), ("--at x_m=0.37 --sensors 2", "grid")],
)
def test_where_rays_cannot_be_chosen_each_is_a_sensor_unless_sensors_are_counted(lidardesign, run, arguments, layout):
    assert lidardesign("fit", run, "--rays", 3, *arguments.split()).code == 0
    assert load_design(run / "designs" / "fit.yaml").layout == layout


def test_constraints_hold_along_a_track_and_at_a_value(lidardesign, run):
    lidardesign("fit", run, "--layout", "scan", "--rays", 4)
    path = run / "designs" / "fit.yaml"
    rules = ("--set", "gate.width_m.max=0.08", "--set", "budget.bandwidth_mbps=0.008")
    along = lidardesign("constrain", path, *rules, "--name", "along", "--json")
    assert along.code == 0, along.err
    assert along.json["satisfied"] is True
    track = load_design(run / "designs" / "along.yaml").track
    assert np.diff(track.gate_m, axis=2).max() <= 0.08
    here = lidardesign("constrain", path, *rules, "--at", "x_m=1", "--name", "here", "--json")
    assert here.code == 0, here.err
    design = load_design(run / "designs" / "here.yaml")
    assert dict(design.at) == {"x_m": 1.0}
    # a design for one value stays for that value unless another one is given
    assert lidardesign("constrain", run / "designs" / "here.yaml", "--name", "again").code == 0
    assert dict(load_design(run / "designs" / "again.yaml").at) == {"x_m": 1.0}
    assert lidardesign("constrain", run / "designs" / "here.yaml", "--at", "x_m=0.5", "--name", "moved").code == 0
    assert dict(load_design(run / "designs" / "moved.yaml").at) == {"x_m": 0.5}


def test_a_track_is_exported_at_a_position(lidardesign, run, tmp_path):
    lidardesign("fit", run, "--layout", "scan", "--rays", 4)
    path = run / "designs" / "fit.yaml"
    for count in (4, 6):
        result = lidardesign("export", path, "--format", "npz", "--at", "x_m=0.25", "--rays", count, "--out", "r.npz")
        assert result.code == 0, result.err
        with np.load(tmp_path / "r.npz") as arrays:
            assert len(arrays["sensor"]) == count
            np.testing.assert_array_equal(arrays["origin_x_m"], 0.25)
    assert lidardesign("export", path, "--format", "sensors-csv", "--at", "x_m=0.25", "--out", "s.csv").code == 0
    assert len((tmp_path / "s.csv").read_text().splitlines()) == 5
    refused = lidardesign("export", path, "--format", "csv")
    assert refused.code == 2
    assert "x_m from 0 to 1" in refused.err


MISTAKES = [
    ("fit run --at x_m", 2, "NAME=VALUE"),
    ("fit run --at x_m=here", 2, "NAME=VALUE"),
    ("fit run --at x_m=nan", 2, "finite"),
    ("fit run --at x_m=0.1 --at x_m=0.2", 2, "twice"),
    ("fit run --at x_m=1.01", 2, "0 to 1"),
    ("fit run --at y_m=0", 2, "x_m"),
    ("fit run --layout even", 2, "--layout scan, or --at x_m=VALUE"),
    ("fit run --layout density --rays 4", 2, "--at x_m=VALUE"),
    ("fit run --layout distributed --rays 4", 2, "--at x_m=VALUE"),
    ("fit run --layout scan --rays 4 --sensors 2", 2, "--sensors"),
    ("constrain run --layout scan --rays 4 --sensors best", 2, "--sensors"),
    ("constrain run --layout even", 2, "--at x_m=VALUE"),
    ("constrain run --at x_m=-0.1", 2, "0 to 1"),
    ("constrain run --layout scan --set origin.fixed_m=[0.5,0,0]", 4, "--at x_m=0.5"),
    ("fit plain --at x_m=0.5", 2, "no conditions"),
    ("constrain plain --at x_m=0.5", 2, "no conditions"),
    ("fit two --sensors 1 --rays 4", 2, "--at x_m=VALUE --at azimuth_rad=VALUE"),
    ("fit two --layout scan --rays 4", 2, "--at x_m=VALUE --at azimuth_rad=VALUE"),
    ("fit turning --layout scan --rays 4", 2, "coordinate of the origin"),
]


@pytest.fixture(scope="module")
def refusing(tmp_path_factory):
    """A folder with runs of several conditions."""
    folder = tmp_path_factory.mktemp("refusing")
    make_run(folder / "plain", count=1000)
    for name, condition in (("run", "[x_m]"), ("two", "[x_m,azimuth_rad]"), ("turning", "[azimuth_rad]")):
        make_conditioned_run(folder / name, 4000, condition)
    return folder


@pytest.mark.parametrize(("arguments", "code", "words"), MISTAKES, ids=[entry[0] for entry in MISTAKES])
def test_a_mistake_gets_one_message_its_exit_code_and_writes_nothing(
    lidardesign, refusing, monkeypatch, arguments, code, words
):
    monkeypatch.chdir(refusing)
    before = files_under(refusing)
    result = lidardesign(*arguments.split())
    assert result.code == code, result.err
    assert words in result.err
    assert result.out == ""
    assert result.err.count("error") == 1
    assert files_under(refusing) == before


def test_several_conditions_are_given_at_once(lidardesign, tmp_path):
    run = make_conditioned_run(tmp_path / "two", 20_000, "[x_m,azimuth_rad]")
    result = lidardesign("fit", run, "--at", "x_m=0.5", "--at", "azimuth_rad=1.6", "--sensors", 1, "--json")
    assert result.code == 0, result.err
    (sensor,) = json.loads(result.out)["sensors"]
    assert sensor["boresight"]["azimuth_rad"] == pytest.approx(1.6)
    assert sensor["field_of_view_rad"]["horizontal"] == 0
    assert np.mean(list(sensor["gate_m"].values())) == pytest.approx(0.6, abs=0.02)


OPEN = """
schema_version: 1
layout: {layout}
sensors:
- name: a
  origin_m: {{mean: [0.5, 0, 0], covariance: [[0.04, 0, 0], [0, 0, 0], [0, 0, 0]]}}
  boresight: {{azimuth_rad: 1.6, elevation_rad: 0.0}}
  field_of_view_rad: {{horizontal: 0.3, vertical: 0.0}}
  gate_m: {{start: 0.4, end: 1.0}}
"""


def test_a_design_by_hand_without_a_number_of_rays_is_exported_at_the_one_that_is_asked_for(lidardesign, tmp_path):
    (tmp_path / "hand.yaml").write_text(OPEN.format(layout="distributed"))
    result = lidardesign("export", "hand.yaml", "--format", "npz", "--rays", 20, "--out", "r.npz")
    assert result.code == 0, result.err
    with np.load(tmp_path / "r.npz") as arrays:
        assert len(np.unique(arrays["origin_x_m"])) == 20
    (tmp_path / "hand.yaml").write_text(OPEN.format(layout="density"))
    refused = lidardesign("export", "hand.yaml", "--format", "npz", "--rays", 20, "--out", "r.npz")
    assert refused.code == 2
    assert "need samples of the learned density" in refused.err


def test_a_design_is_exported_with_the_rays_that_it_is_evaluated_with(lidardesign, run, tmp_path):
    from lidardesign.fitting.request import Layouts
    from lidardesign.samples import load_samples

    for layout, gates in (("grid", "ray"), ("density", "ray"), ("distributed", "sensor"), ("distributed", "ray")):
        name = f"{layout}-{gates}"
        made = ("--at", "x_m=0.37", "--layout", layout, "--rays", 8, "--sensors", 2, "--gates", gates)
        assert lidardesign("fit", run, *made, "--name", name).code == 0
        path = run / "designs" / f"{name}.yaml"
        assert lidardesign("export", path, "--format", "npz", "--rays", 12, "--out", "r.npz").code == 0
        evaluated = Layouts({name: log_target})(load_design(path), 12, load_samples(run))
        with np.load(tmp_path / "r.npz") as arrays:
            np.testing.assert_array_equal(arrays["gate_start_m"], evaluated.gate_m[:, 0])
            np.testing.assert_array_equal(arrays["gate_end_m"], evaluated.gate_m[:, 1])
            np.testing.assert_array_equal(arrays["azimuth_rad"], np.arctan2(*evaluated.direction[:, 1::-1].T))
        own = [np.ptp(evaluated.gate_m[evaluated.sensor == index, 1]) > 0 for index in (0, 1)]
        assert any(own) == (gates == "ray")


def test_a_scan_for_one_value_is_fitted_anew_once_for_all_places(lidardesign, run, monkeypatch):
    from lidardesign.mixture import fit as fit_module
    from lidardesign.samples import load_samples

    assert lidardesign("fit", run, "--at", "x_m=0.37", "--layout", "scan", "--rays", 4, "--name", "here").code == 0
    design, samples, fits = load_design(run / "designs" / "here.yaml"), load_samples(run), []
    refit = fit_module.fit_like
    monkeypatch.setattr(fit_module, "fit_like", lambda *given, **named: fits.append(1) or refit(*given, **named))
    places = ({"x_m": x} for x in (0.0, 0.37, 1.0))
    first, *others = (fit_module.rays_at(design, 7, samples, at=at, retarget=log_target) for at in places)
    assert len(fits) == 1
    for other, x in zip(others, (0.37, 1.0), strict=True):
        np.testing.assert_array_equal(other.direction, first.direction)
        np.testing.assert_array_equal(other.origin_m[:, 0], x)
