"""Designs with chosen rays: fields and gates around their rays, sensors that all fire, certificates, and workers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lidardesign_tasks.flatland import FlatlandTask
from lidardesign_tasks.meshes import MeshesTask
from support.command_line import make_run
from support.conditioned_runs import make_conditioned_run
from support.mesh_runs import make_mesh_run

from lidardesign.api.run import open_run
from lidardesign.constraints.check import check_design
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.fitting import fit
from lidardesign.rays.information import MOST_SELECTED
from lidardesign.run.yaml import dump_yaml
from lidardesign.sensors.design_file import design_document
from lidardesign.sensors.sensor import tangent_coordinates

FIELD_RAD = 2e-7  # by which fields may be wider than their rays: digits of angles in files


@pytest.fixture(autouse=True)
def few_scenes(monkeypatch):
    """Rays are chosen on three scenes, for two numbers where none is asked for."""
    for task in (FlatlandTask, MeshesTask):
        monkeypatch.setattr(task, "defaults", replace(task.defaults, rays=(8, 24)))
    for module in ("rays.information", "rays.training_scenes", "rays.selection", "fitting.chosen", "fitting.trials"):
        monkeypatch.setattr(f"lidardesign.{module}.FEW_SCENES", 3)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs whose sensors stand at a given place, may choose one, and move along a condition."""
    place = tmp_path_factory.mktemp("runs")
    folders = {
        "given": make_mesh_run(place / "given", count=1500),
        "free": make_run(place / "free"),
        "moving": make_conditioned_run(place / "moving", count=6000),
    }
    return {name: open_run(folder) for name, folder in folders.items()}


def all_rays(design):
    """The rays of all numbers at all knots."""
    for pattern in design.patterns:
        for knot in pattern.knots or (None,):
            yield pattern.at(knot)


def of_sensor(design, index):
    """Tangent coordinates and gates of all rays of a sensor."""
    frame = design.sensors[index].frame
    own = [rays.subset(rays.sensor == index) for rays in all_rays(design)]
    tangent = np.concatenate([tangent_coordinates(frame, rays.direction) for rays in own])
    return tangent, np.concatenate([rays.gate_m for rays in own])


@pytest.mark.parametrize("gates", ["sensor", "ray"])
@pytest.mark.parametrize("name", ["given", "free", "moving"])
def test_fields_and_gates_are_as_small_as_their_rays_allow(runs, name, gates):
    design = runs[name].fit(sensors=2, gates=gates).specification
    assert design.counts == sorted(runs[name].task.defaults.rays)
    for index, sensor in enumerate(design.sensors):
        tangent, gate_m = of_sensor(design, index)
        field_rad = np.array(sensor.field_of_view_rad)
        spare_rad = (field_rad - 2 * np.abs(tangent).max(axis=0))[field_rad > 0]
        assert ((spare_rad >= 0) & (spare_rad <= FIELD_RAD)).all()
        assert sensor.gate_m == (gate_m[:, 0].min(), gate_m[:, 1].max())
        assert (gates == "ray") == (len(np.unique(gate_m, axis=0)) > 1)
        if name == "given":
            # where it may turn it looks at the middle of its rays
            np.testing.assert_allclose(tangent.min(axis=0), -tangent.max(axis=0), atol=0.02)
    fired = design.rays_per_sensor()
    np.testing.assert_allclose([sensor.weight for sensor in design.sensors], fired / fired.sum(), rtol=1e-12)


MINIMA = {
    "fields": {"field_of_view": {"horizontal_deg": {"min": 30}, "vertical_deg": {"min": 20}}},
    "a gate": {"gate": {"width_m": {"min": 1.2}}},
    "ends of gates": {"gate": {"start_m": {"max": 1.9}, "end_m": {"min": 3.4}}},
}


@pytest.mark.parametrize("gates", ["sensor", "ray"])
@pytest.mark.parametrize("name", MINIMA)
def test_they_do_not_shrink_below_what_constraints_ask_for(runs, name, gates):
    design = runs["given"].fit(sensors=2, rays=36, gates=gates, constraints=MINIMA[name]).specification
    for index, sensor in enumerate(design.sensors):
        _, gate_m = of_sensor(design, index)
        assert name != "fields" or np.degrees(sensor.field_of_view_rad) == pytest.approx([30, 20], rel=1e-6)
        assert name != "a gate" or np.diff(gate_m, axis=1).min() >= 1.2 - 1e-9
        assert name != "ends of gates" or gate_m[:, 0].max() <= 1.9 < 3.4 <= gate_m[:, 1].min()


RULES = {
    "gates": {"gate": {"start_m": {"min": 2.2}, "end_m": {"max": 3.0}, "width_m": {"max": 0.4}}},
    "least widths": {"gate": {"width_m": {"min": 0.05, "max": 1.5}}},
    "fields": {"field_of_view": {"horizontal_deg": {"max": 12}, "vertical_deg": {"max": 8}}},
    "boresights": {"boresight": {"azimuth_deg": {"min": 175, "max": 178}, "elevation_deg": {"max": 0}}},
    "tight bandwidth": {"budget": {"bandwidth_mbps": 0.2}},
    "bins": {"budget": {"bandwidth_mbps": 0.5, "bin_ps": 300.0, "bits_per_bin": 16, "rate_hz": 30}},
    "all": {
        "gate": {"width_m": {"max": 0.8}},
        "budget": {"bandwidth_mbps": 0.5},
        "each": [{"gate": {"end_m": {"max": 2.7}}}, {"gate": {"start_m": {"min": 2.3}}}],
    },
}


@pytest.mark.parametrize("gates", ["sensor", "ray"])
@pytest.mark.parametrize("name", RULES)
def test_constraints_are_kept_by_sensors_and_rays_of_the_written_design(runs, name, gates):
    run = runs["given"]
    design = run.fit(sensors=2, rays=40, gates=gates, constraints=RULES[name]).specification
    checks = check_design(design_document(design), RULES[name], run.config.space)
    assert [check.name for check in checks if not check.satisfied] == []
    assert len(design.rays()) == 40
    assert design.rays_per_sensor().min() > 0


def test_rays_start_all_over_a_region_where_constraints_allow_one_and_else_at_their_sensors_place(runs):
    for origin in ({}, {"spread_m": {"max": 0.1}}):
        design = runs["free"].fit(sensors=2, rays=16, constraints={"origin": origin}).specification
        for index, sensor in enumerate(design.sensors):
            own = design.rays().origin_m[design.rays().sensor == index]
            assert (sensor.region_m > 0) == bool(origin)
            assert len(np.unique(own, axis=0)) == (len(own) if origin else 1)
            assert origin or (own == sensor.origin_m).all()


@pytest.mark.parametrize(("name", "sensors"), [("given", 12), ("free", 5), ("moving", 4)])
def test_where_a_number_of_sensors_was_asked_for_each_of_them_fires(runs, name, sensors):
    design = runs[name].fit(sensors=sensors, rays=sensors, seed=1).specification
    assert design.rays_per_sensor().tolist() == [1] * sensors


@pytest.mark.parametrize(("name", "most", "open_below"), [("given", 12, 12), ("free", 3, 1), ("moving", 3, 2)])
def test_where_the_number_is_free_no_sensor_is_idle_and_none_is_left_out_that_constraints_ask_for(
    runs, name, most, open_below, monkeypatch
):
    monkeypatch.setattr("lidardesign.fitting.fit.COUNTS", (most,))
    notes, least = [], max(most - open_below, 1)
    constraints = {"sensors": {"min": least}}
    design = runs[name].fit(rays=most, constraints=constraints, seed=0, notes=notes.append).specification
    assert design.rays_per_sensor().min() > 0
    assert least <= len(design.sensors) <= most
    assert (len(design.sensors) < most) == any("fitted again with" in note for note in notes)


def test_more_sensors_than_samples_carry_are_fitted_again_with_fewer(runs, monkeypatch):
    monkeypatch.setattr("lidardesign.fitting.fit.COUNTS", (5,))
    asked, notes, fit_sensors = [], [], fit.fit_sensors

    def fails_after_the_trial(problem):
        asked.append(problem.sensors)
        if len(asked) > 1 and problem.sensors > 3:
            raise InfeasibleError("too few samples", conflicts=["--sensors"])
        return fit_sensors(problem)

    monkeypatch.setattr(fit, "fit_sensors", fails_after_the_trial)
    design = runs["given"].fit(rays=36, notes=notes.append).specification
    assert asked[:4] == [5, 5, 4, 3]
    assert len(design.sensors) == asked[-1] <= 3
    assert len([note for note in notes if "fitted again" in note]) >= 2


def test_where_every_number_is_certified_rays_are_the_same(runs):
    few, every = (runs["given"].fit(sensors=1, certify=certify).specification for certify in (False, True))
    assert few.certificates[0] in every.certificates
    documents = [design_document(one) | {"certificates": []} for one in (few, every)]
    assert dump_yaml(documents[0]) == dump_yaml(documents[1])


def test_two_workers_find_the_same_bytes_as_one(runs):
    fitted = [runs["moving"].fit(sensors=2, rays=12, seed=5, workers=workers).specification for workers in (1, 2)]
    alone, shared = (dump_yaml(design_document(one)) for one in fitted)
    assert alone == shared


def test_along_a_condition_rays_lie_in_their_sensors_fields_everywhere_and_at_one_value_there_alone(runs):
    run = runs["moving"]
    design = run.fit(sensors=2, rays=8).specification
    assert design.condition == "x_m"
    low, high = design.patterns[-1].ends
    for value in np.linspace(low, high, 7):
        rays = design.rays(8, at={"x_m": float(value)})
        assert (rays.origin_m[:, 0] == value).all()
        for index, sensor in enumerate(design.sensors):
            tangent = tangent_coordinates(sensor.frame, rays.direction[rays.sensor == index])
            assert (np.abs(tangent) <= np.array(sensor.field_of_view_rad) / 2 + 1e-9).all()
    here = run.fit(sensors=2, rays=8, at={"x_m": 0.4}).specification
    assert (here.condition, here.at) == (None, {"x_m": 0.4})
    assert (here.rays().origin_m[:, 0] == 0.4).all()


def test_a_box_across_the_way_of_a_condition_is_refused(runs):
    box = {"low_m": [0.4, -1, -1], "high_m": [0.6, 1, 1]}
    with pytest.raises(InfeasibleError):
        runs["moving"].fit(sensors=1, rays=4, constraints={"origin": {"exclude": [box]}})


def test_more_rays_than_can_be_chosen_are_refused(runs):
    with pytest.raises(ConfigError, match="rays"):
        runs["given"].fit(sensors=1, rays=MOST_SELECTED + 1)
