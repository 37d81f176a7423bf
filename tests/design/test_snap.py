"""Fitted sensors replaced by real parts: which ones, inside which constraints, and what they lose."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import make_run
from support.tables import each_row

from lidardesign.design.catalog.library import find_part, load_library
from lidardesign.design.constraints.check import check_design
from lidardesign.design.constraints.document import Constraints, wants_parts
from lidardesign.design.constraints.feasibility import BandwidthBudget
from lidardesign.design.files import design_document, design_from_document, load_design
from lidardesign.design.fit import fit
from lidardesign.design.layouts.rays import lay_out
from lidardesign.design.mixture.mixture import Mixture
from lidardesign.design.sensor import tangent_coordinates
from lidardesign.design.snap.fit import afford_rays, capped_split, count_rays, useful_split
from lidardesign.design.snap.parts import (
    PartChoice,
    PartOptions,
    fit_part_poses,
    nearest_parts,
    part_options,
    parts_of,
    shapes_of,
)
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.samples import Samples
from lidardesign.space import DesignSpace, aim

SPACE = DesignSpace((0, 0, 0, -0.8, -0.8, 0.1), (0, 0, 0, 0.8, 0.8, 3.0))
FREE = DesignSpace((-0.2, -0.2, 0, -0.8, -0.8, 0.1), (0.2, 0.2, 0, 0.8, 0.8, 3.0))
OWN = """
schema_version: 1
maker: Us
product: Homemade
kind: multi-zone
summary: A ranger of our own.
sources:
  bench: {{title: Our bench, kind: measurement}}
pattern:
  - {{kind: zones, columns: {columns}, rows: {rows}, source: bench}}
field_of_view_deg:
  - {{azimuth: [-{h}, {h}], elevation: [-{v}, {v}], source: bench}}
near_m:
  - {{value: {near}, source: bench}}
far_m:
  - {{value: {far}, source: bench}}
rate_hz:
  - {{value: 20, source: bench}}
"""


def own_part(folder, name, h=10.0, v=10.0, near=0.2, far=2.5, columns=8, rows=8):
    path = folder / f"{name}.yaml"
    path.write_text(OWN.format(h=h / 2, v=v / 2, near=near, far=far, columns=columns, rows=rows))
    return str(path)


def samples(space=SPACE, spread=(0.05, 0.12), seed=0, centres=((1.5, -0.5, 0.0), (1.5, 0.6, 0.2))):
    """Equal samples of blobs of scene points, seen from anywhere in the space's box."""
    generator = np.random.default_rng(seed)
    points = []
    for centre in centres:
        low, high = np.array(space.low[:3], float), np.array(space.high[:3], float)
        origins = low + generator.uniform(size=(1500, 3)) * (high - low)
        blob = np.array(centre) + generator.normal(0, 1, (1500, 3)) * [0.03, *spread]
        points.append(aim(origins, blob))
    drawn = space.wrap(np.concatenate(points))
    drawn = drawn[space.contains(drawn)]
    return Samples(drawn, np.zeros(len(drawn)), np.zeros(len(drawn)), space)


def snapped(space=SPACE, rays=None, sensors=2, data=None, **rules):
    constraints = Constraints.from_mapping({"snap": "catalog", **rules})
    return fit(data or samples(space), sensors=sensors, rays=rays, constraints=constraints, seed=1,
               retarget=lambda points: np.zeros(len(points)))  # fmt: skip


# the constraint


@pytest.mark.parametrize(
    "values",
    [
        {"snap": "catalog"},
        {"snap": {"otherwise": "keep"}},
        {"snap": {"parts": ["vl53l5cx", "tmf8828"], "pose": "fitted"}},
        {"each": [{"snap": "catalog"}, {}]},
    ],
)
def test_the_key_is_written_as_it_was_given(values):
    constraints = Constraints.from_mapping(values)
    assert constraints.as_document() == values
    assert Constraints.from_mapping(constraints.as_document()).as_document() == values
    assert wants_parts(constraints.rules)


def test_an_empty_mapping_is_the_short_form():
    assert Constraints.from_mapping({"snap": {}}).as_document() == {"snap": "catalog"}
    assert not wants_parts(Constraints.from_mapping({"gate": {"width_m": {"max": 1.0}}}).rules)


@each_row(
    ("value", "message"),
    [
        ("shop", "catalog"),
        ({"otherwise": "leave"}, "refuse"),
        ({"pose": "best"}, "refitted"),
        ({"parts": []}, "snap.parts"),
        ({"part": ["vl53l5cx"]}, "did you mean 'parts'"),
        (True, "snap"),
    ],
)
def test_other_values_are_refused_with_what_is_allowed(value, message):
    with pytest.raises(ConfigError, match=message):
        Constraints.from_mapping({"snap": value})


def test_parts_are_named_with_and_without_mode_by_file_and_by_folder(tmp_path):
    own_part(tmp_path, "mine")
    other = own_part(tmp_path, "yours")

    def names(*texts):
        return sorted(part.name for part in parts_of(Constraints.from_mapping({"snap": {"parts": [*texts]}}).snap))

    assert names("vl53l5cx") == ["vl53l5cx", "vl53l5cx:4x4"]
    assert names("vl53l5cx:4x4") == ["vl53l5cx:4x4"]
    assert names(other) == ["yours"]
    assert names(str(tmp_path)) == ["mine", "yours"]
    assert names("tmf8828", other) == ["tmf8828", "yours"]
    with pytest.raises(ConfigError, match="no part 'nothing'"):
        names("nothing")


def test_parts_that_nobody_says_the_nearest_range_of_are_none_of_the_catalogue():
    chosen = parts_of(Constraints.from_mapping({"snap": "catalog"}).snap)
    assert chosen
    assert all(part.value("near_m") is not None for part in chosen)
    silent = next(part for part in load_library().every_mode() if part.value("near_m") is None)
    named = Constraints.from_mapping({"snap": {"parts": [silent.name]}}).snap
    assert silent.name in [part.name for part in parts_of(named)]


# which parts keep the constraints


def naive_keeps(part, rules):
    """Whether a part's own figures keep bounds, written down once more."""
    view = [math.degrees(angle) for angle in part.field_of_view_rad]
    start, end = max(part.range_m[0], SPACE.low[5]), min(part.range_m[1], SPACE.high[5])
    figures = {
        ("field_of_view", "horizontal_deg"): view[0], ("field_of_view", "vertical_deg"): view[1],
        ("gate", "start_m"): start, ("gate", "end_m"): end, ("gate", "width_m"): end - start,
    }  # fmt: skip
    kept = start <= 1.5 <= end
    for (section, key), value in figures.items():
        bounds = rules.get(section, {}).get(key, {})
        kept &= bounds.get("min", -math.inf) - 1e-6 <= value <= bounds.get("max", math.inf) + 1e-6
    return kept


RULES = st.fixed_dictionaries(
    {},
    optional={
        "field_of_view": st.fixed_dictionaries(
            {}, optional={"horizontal_deg": st.fixed_dictionaries({"max": st.floats(20, 150)}),
                          "vertical_deg": st.fixed_dictionaries({"min": st.floats(1, 60)})}),
        "gate": st.fixed_dictionaries(
            {}, optional={"end_m": st.fixed_dictionaries({"min": st.floats(1, 3)}),
                          "start_m": st.fixed_dictionaries({"max": st.floats(0.1, 1)})}),
    },
)  # fmt: skip


@given(rules=RULES)
def test_a_sensor_may_become_the_parts_whose_own_figures_keep_its_constraints(rules):
    constraints = Constraints.from_mapping({"snap": {"otherwise": "keep"}, **rules})
    (found,) = part_options(constraints.rules, SPACE, [1.5])
    expected = {part.name for part in parts_of(constraints.snap) if naive_keeps(part, rules)}
    assert {shape.part.name for shape in found.shapes} == expected
    assert bool(found.lacking) == (not expected)


def test_constraints_that_no_part_keeps_are_refused_by_the_fewest_names():
    narrow = {"gate": {"width_m": {"max": 0.1}}, "field_of_view": {"horizontal_deg": {"max": 100}}}
    with pytest.raises(InfeasibleError) as error:
        snapped(**narrow)
    assert error.value.conflicts == ("gate.width_m.max", "snap")
    both = {"field_of_view": {"horizontal_deg": {"max": 34}, "vertical_deg": {"min": 50, "max": 55}}}
    with pytest.raises(InfeasibleError) as error:
        snapped(**both)
    assert {"field_of_view.horizontal_deg.max"} < {*error.value.conflicts}
    assert "gate" not in str(error.value.conflicts)


def test_a_part_that_measures_elsewhere_is_none_for_a_sensor(tmp_path):
    far = own_part(tmp_path, "far", near=2.0, far=2.9)
    with pytest.raises(InfeasibleError) as error:
        snapped(snap={"parts": [far]})
    assert "space.range_m" in error.value.conflicts


def test_sensors_without_a_part_may_stay_as_they_are():
    found = snapped(snap={"otherwise": "keep"}, gate={"width_m": {"max": 0.3}}, rays=50)
    assert found.satisfied
    assert [sensor.part for sensor in found.design.sensors] == [None, None]
    assert sum("no part keeps gate.width_m.max" in note for note in found.notes) == 2
    assert all(np.diff(sensor.gate_m)[0] <= 0.3 + 1e-9 for sensor in found.design.sensors)
    assert len(lay_out(found.design)) == 50


def test_each_sensor_may_have_its_own_choice(tmp_path):
    found = snapped(each=[{"snap": {"parts": ["vl53l5cx"]}}, {"snap": {"parts": ["tmf8828"]}}])
    assert [sensor.part for sensor in found.design.sensors] == ["vl53l5cx", "tmf8828"]
    constraints = Constraints.from_mapping({"each": [{"snap": {"parts": ["vl53l5cx"]}}, {}]})
    one = fit(samples(), sensors=2, rays=60, constraints=constraints, seed=1)
    assert [sensor.part for sensor in one.design.sensors] == ["vl53l5cx", None]
    assert len(lay_out(one.design)) == 60


# the nearest part


@pytest.mark.parametrize(("h", "v"), [(6.0, 18.0), (18.0, 6.0), (12.0, 12.0)])
def test_a_part_of_a_sensors_own_shape_is_found_among_others_and_loses_next_to_nothing(tmp_path, h, v):
    """The density is one normal blob; a part whose field and range are its 95 % intervals is it."""
    generator = np.random.default_rng(3)
    points = np.zeros((4000, 6))
    spread = np.radians([h, v]) / (2 * 1.96)
    points[:, 3:5] = generator.normal(0, 1, (4000, 2)) * spread
    points[:, 5] = generator.normal(1.5, 0.3 / 1.96, 4000)
    data = Samples(points, np.zeros(4000), np.zeros(4000), SPACE)
    same = own_part(tmp_path, "same", h, v, near=1.2, far=1.8)
    others = [own_part(tmp_path, f"other{index}", 1.7 * h, v / 1.7, near=1.2, far=1.8) for index in range(2)] + [
        own_part(tmp_path, "deep", h, v, near=0.3, far=2.7)
    ]
    found = snapped(sensors=1, data=data, snap={"parts": [*others, same]})
    assert found.design.sensors[0].part == "same"
    (row,) = found.snap["sensors"]
    assert abs(row["loss_nats"]) < 0.01
    np.testing.assert_allclose(row["field_of_view_rad"]["part"], np.radians([h, v]), rtol=1e-9)


def test_a_part_is_turned_where_the_sensor_lies_on_its_side(tmp_path):
    tall = own_part(tmp_path, "tall", 8.0, 24.0)
    wide = samples(spread=(0.16, 0.05), centres=((1.5, 0.0, 0.0),))
    (turned,) = snapped(sensors=1, data=wide, snap={"parts": [tall]}).snap["sensors"]
    (upright,) = snapped(sensors=1, data=samples(spread=(0.05, 0.16), centres=((1.5, 0.0, 0.0),)),
                         snap={"parts": [tall]}).snap["sensors"]  # fmt: skip
    assert turned["turned"]
    assert not upright["turned"]
    assert turned["loss_nats"] == pytest.approx(upright["loss_nats"], abs=0.05)


def test_losses_are_what_the_mixture_loses_by_each_part_alone():
    """The naive way: the whole mixture's density with one component exchanged."""
    from lidardesign.design.mixture.ensemble import Ensemble
    from lidardesign.design.mixture.mixture import log_density
    from lidardesign.design.snap.parts import shaped_mixture

    ensemble = fitted_ensemble()
    assert isinstance(ensemble, Ensemble)
    (group,), (trace,) = ensemble.parts, ensemble.results
    shapes = [shape for name in ("vl53l5cx", "tmf8828") for shape in shapes_of(find_part(name), SPACE)]
    choices = nearest_parts(ensemble, [PartOptions(shapes), PartOptions(shapes)], 200, seed=0)
    heaviest = int(np.argmax(trace.mixture.weights))
    before = group.features.weights @ log_density(trace.mixture, group.features)
    for shape, loss in zip(shapes, choices[heaviest].losses, strict=True):
        exchanged = [shape if row == heaviest else None for row in range(2)]
        mixture = shaped_mixture(trace.mixture, exchanged, group.bounds.interval, group.features.axes)
        share = min(1.0, shape.part.rays / (200 * mixture.weights[heaviest]))
        weights = mixture.weights * np.where(np.arange(2) == heaviest, share, 1.0)
        rows = [np.log(w) + log_density(mixture.take(np.array([k])), group.features) for k, w in enumerate(weights)]
        after = group.features.weights @ np.logaddexp(*rows)
        assert loss == pytest.approx(before - after, abs=1e-9)


def fitted_ensemble(sensors=2):
    """A fit of the samples, as snapping is given it."""
    from lidardesign.design.layouts.layout import FitProblem, fit_sensors

    budget = BandwidthBudget.of(Constraints(), None)
    request = FitProblem(
        samples(), Constraints(), Constraints().rules, budget, sensors, 1, 4, 20_000, 0.95, "parts", "sensor", None
    )
    return fit_sensors(request).ensemble


def test_refitting_poses_never_lowers_the_likelihood_and_keeps_the_shapes_and_shares():
    ensemble = fitted_ensemble()
    shape = shapes_of(find_part("vl53l5cx"), SPACE)[0]
    choices = [PartChoice(shape, (0.0,)), PartChoice(shape, (0.0,))]
    moved, still = (fit_part_poses(ensemble, choices, [held, held]) for held in (False, True))
    (history,) = (trace.history for trace in moved.results)
    assert (np.diff(history) >= 0).all()
    assert moved.log_likelihood > still.log_likelihood
    for found in (moved, still):
        mixture: Mixture = found.results[0].mixture
        np.testing.assert_allclose(mixture.weights, ensemble.results[0].mixture.weights)
        expected = shape.spread_rad(ensemble.parts[0].bounds.interval, ensemble.parts[0].features.axes)
        np.testing.assert_allclose(mixture.spread_rad, np.tile(expected, (2, 1)), rtol=1e-7)
    before, after = ensemble.results[0].mixture, still.results[0].mixture
    for key in ("azimuth_rad", "elevation_rad", "roll_rad", "origin_m"):
        np.testing.assert_allclose(getattr(after, key), getattr(before, key), atol=1e-9)


def test_a_part_with_few_rays_weighs_no_more_than_they_do(tmp_path):
    many = own_part(tmp_path, "many", columns=8, rows=8)
    few = own_part(tmp_path, "few", columns=1, rows=1)
    found = snapped(snap={"parts": [few, many]})
    assert {sensor.part for sensor in found.design.sensors} == {"many"}
    alone = snapped(snap={"parts": [few]})
    assert alone.snap["sensors"][0]["loss_nats"] > found.snap["sensors"][0]["loss_nats"] + 0.5


# rays, gates and budgets


def test_the_design_fires_the_rays_of_its_parts():
    found = snapped(rays=90)
    design = found.design
    assert (design.layout, design.rays, len(design.ray_table.sensor)) == ("fixed", 90, 90)
    rays = lay_out(design)
    for index, sensor in enumerate(design.sensors):
        part = find_part(sensor.part)
        own = rays.direction[rays.sensor == index]
        assert len(own) == sensor.rays <= part.rays
        middle = np.abs(tangent_coordinates(sensor.frame, own)) <= np.array(part.field_of_view_rad) / 2 + 1e-9
        assert middle.all()
        start, end = max(part.range_m[0], SPACE.low[5]), min(part.range_m[1], SPACE.high[5])
        np.testing.assert_allclose(rays.gate_m[rays.sensor == index], np.tile([start, end], (len(own), 1)))
        np.testing.assert_allclose(sensor.gate_m, (start, end), rtol=1e-9)
        np.testing.assert_allclose(sensor.field_of_view_rad, part.field_of_view_rad, rtol=1e-9)


def test_the_same_seed_makes_the_same_design_and_it_survives_its_file():
    first, second = (design_document(snapped(rays=90).design) for _ in range(2))
    assert first == second
    assert design_document(design_from_document(json.loads(json.dumps(first)))) == first


def test_what_parts_lost_is_said_part_by_part():
    found = snapped(rays=90)
    document = found.as_dict()["snap"]
    assert set(document["log_likelihood"]) == {"fitted", "parts"}
    assert document["log_likelihood"]["parts"] == pytest.approx(found.log_likelihood)
    assert document["log_likelihood"]["fitted"] > found.log_likelihood
    assert [row["sensor"] for row in document["sensors"]] == [sensor.name for sensor in found.design.sensors]
    assert sum(row["rays"]["part"] for row in document["sensors"]) == 90
    assert sum(row["rays"]["fitted"] for row in document["sensors"]) == 90
    for row, sensor in zip(document["sensors"], found.design.sensors, strict=True):
        assert row["gate_m"]["part"] == pytest.approx(sensor.gate_m)
        assert row["bandwidth_mbps"]["part"] > row["bandwidth_mbps"]["fitted"]
        assert row["rays"]["pattern"] == find_part(sensor.part).rays
    assert "snap" not in fit(samples(), sensors=2).as_dict()


def test_more_rays_than_parts_have_change_parts_before_they_are_refused(tmp_path):
    near = own_part(tmp_path, "near", 12.0, 20.0, near=1.0, far=2.0)
    dense = own_part(tmp_path, "dense", 40.0, 40.0, columns=30, rows=30)
    parts = {"parts": [near, dense]}
    assert {row["part"] for row in snapped(snap=parts, rays=60).snap["sensors"]} == {"near"}
    more = snapped(snap=parts, rays=500)
    assert len(lay_out(more.design)) == 500
    assert {row["part"] for row in more.snap["sensors"]} >= {"dense"}
    with pytest.raises(InfeasibleError) as error:
        snapped(snap={"parts": [near]}, rays=500)
    assert error.value.conflicts == ("--rays", "snap")
    with pytest.raises(InfeasibleError) as error:
        snapped(snap={"parts": [near]}, budget={"rays": 500})
    assert error.value.conflicts == ("budget.rays", "snap")


def test_a_bandwidth_changes_parts_or_thins_rays_before_it_is_refused(tmp_path):
    deep = own_part(tmp_path, "deep", 12.0, 20.0, near=0.2, far=2.9)
    short = own_part(tmp_path, "short", 40.0, 40.0, near=1.3, far=1.7)
    wanted = {"snap": {"parts": [deep, short]}, "rays": 100}
    free = snapped(**wanted)
    cost = sum(row["bandwidth_mbps"]["part"] for row in free.snap["sensors"])
    half = snapped(**wanted, budget={"bandwidth_mbps": cost / 2})
    assert half.satisfied
    assert {row["part"] for row in half.snap["sensors"]} >= {"short"}
    with pytest.raises(InfeasibleError) as error:
        snapped(**wanted, budget={"bandwidth_mbps": cost / 50})
    assert error.value.conflicts == ("budget.bandwidth_mbps", "--rays", "snap")
    thinned = snapped(snap={"parts": [deep]}, budget={"bandwidth_mbps": 0.5})
    assert thinned.satisfied
    assert thinned.design.rays < snapped(snap={"parts": [deep]}).design.rays


@given(
    weights=st.lists(st.floats(0, 1), min_size=1, max_size=6),
    most=st.lists(st.integers(0, 40), min_size=6, max_size=6),
    count=st.integers(0, 150),
)
def test_a_capped_split_sums_exactly_and_never_passes_a_cap(weights, most, count):
    caps = np.array(most[: len(weights)])
    shares = capped_split(np.array(weights), count, caps)
    if caps.sum() < count:
        assert shares is None
    else:
        assert shares.sum() == count
        assert (shares <= caps).all()
        assert (shares >= 0).all()


def test_rays_that_look_at_something_go_first():
    weights, useful, most = np.array([0.9, 0.1]), np.array([10, 30]), np.array([64, 64])
    assert useful_split(weights, 10, useful, most).tolist() == [9, 1]
    assert useful_split(weights, 40, useful, most).tolist() == [10, 30]
    assert useful_split(weights, 50, useful, most).tolist() == [19, 31]
    assert useful_split(weights, 128, useful, most).tolist() == [64, 64]


def test_rays_that_nobody_asked_for_are_those_that_see_something():
    useful = np.array([40, 10])
    free = BandwidthBudget.of(Constraints(), None)
    widths = np.array([1.0, 1.0])
    assert count_rays(useful, np.array([0.5, 0.5]), widths, free).tolist() == [40, 10]
    mixed = count_rays(np.array([40, 0]), np.array([0.8, 0.2]), widths, free)
    assert mixed.tolist() == [40, 10]
    tight = BandwidthBudget.of(Constraints.from_mapping({"budget": {"bandwidth_mbps": 0.3}}), None)
    few = count_rays(useful, np.array([0.5, 0.5]), widths, tight)
    assert tight.mbps(widths, few, int(few.sum())) <= 0.3 * 1.2
    assert tight.model.mbps_of_widths(widths, few) <= 0.3
    assert (few >= 1).all()


def test_choices_that_are_affordable_stay():
    shape = shapes_of(find_part("vl53l5cx"), SPACE)[0]
    options = [PartOptions([shape])]
    choice = [PartChoice(shape, (0.1,))]
    found = afford_rays(choice, options, np.ones(1), np.ones(1), BandwidthBudget.of(Constraints(), 64))
    assert found == choice
    with pytest.raises(InfeasibleError, match="have 64 rays, 1 fewer"):
        afford_rays(choice, options, np.ones(1), np.ones(1), BandwidthBudget.of(Constraints(), 65))


# places


def test_parts_of_moving_sensors_stand_at_one_place():
    found = snapped(FREE, rays=60)
    assert found.satisfied
    assert any("at one place" in note for note in found.notes)
    for index, sensor in enumerate(found.design.sensors):
        assert not np.any(sensor.origin_covariance_m2)
        starts = found.design.ray_table.origin_m[found.design.ray_table.sensor == index]
        np.testing.assert_allclose(starts, np.tile(sensor.origin_m, (len(starts), 1)))


def test_mounts_boxes_and_boresights_are_kept():
    found = snapped(
        FREE, rays=60, origin={"mounts_m": [[0.1, 0.1, 0], [-0.1, -0.1, 0]]}, boresight={"elevation_deg": {"max": 3.0}}
    )
    assert found.satisfied
    assert {tuple(sensor.origin_m) for sensor in found.design.sensors} == {(0.1, 0.1, 0.0), (-0.1, -0.1, 0.0)}
    assert max(sensor.elevation_rad for sensor in found.design.sensors) <= math.radians(3.0) + 1e-9


def test_parts_that_see_the_same_fire_between_each_others_rays():
    data = samples(centres=((1.5, 0.0, 0.0),), spread=(0.05, 0.05))
    found = snapped(sensors=2, rays=128, data=data, snap={"parts": ["vl53l5cx:8x8"]})
    rays = lay_out(found.design).direction
    assert len(np.unique(np.round(rays, 6), axis=0)) == 128


# the independent checker


def broken(document, **changes):
    """A design document with one sensor's values changed."""
    sensor = {**document["sensors"][0], **changes}
    return {**document, "sensors": [sensor, *document["sensors"][1:]]}


def test_the_checker_knows_a_part_from_what_is_none():
    document = design_document(snapped(rays=90).design)
    rules = {"snap": "catalog"}

    def verdict(changed):
        return [check.satisfied for check in check_design(changed, rules, SPACE) if check.name == "s0.snap"]

    assert verdict(document) == [True]
    sensor = document["sensors"][0]
    view, gate = sensor["field_of_view_rad"], sensor["gate_m"]
    assert verdict(broken(document, part="vlp-16")) == [False]
    assert verdict(broken(document, part="no-such-part")) == [False]
    assert verdict(broken(document, part=None)) == [False]
    assert verdict(broken(document, field_of_view_rad={**view, "vertical": view["vertical"] / 2})) == [False]
    assert verdict(broken(document, gate_m={**gate, "end": 1e6})) == [False]
    assert verdict({**document, "ray_table": None}) == [False]
    for column, change in (("azimuth_rad", 0.02), ("origin_y_m", 0.1)):
        values = [value + change for value in document["ray_table"][column]]
        assert verdict({**document, "ray_table": {**document["ray_table"], column: values}}) == [False]
    twice = {key: [values[0], *values[:1], *values[2:]] for key, values in document["ray_table"].items()}
    assert verdict({**document, "ray_table": twice}) == [False]


def test_the_checker_admits_only_the_parts_that_are_named(tmp_path):
    path = own_part(tmp_path, "mine")
    own = design_document(snapped(snap={"parts": [path]}, rays=20).design)
    shipped = design_document(snapped(snap={"parts": ["vl53l5cx"]}, rays=20).design)

    def kept(document, snap):
        return all(check.satisfied for check in check_design(document, {"snap": snap}, SPACE) if "snap" in check.name)

    assert kept(own, {"parts": [path]})
    assert kept(own, {"parts": [str(tmp_path)]})
    assert not kept(own, "catalog")
    assert kept(shipped, {"parts": ["vl53l5cx"]})
    assert not kept(shipped, {"parts": ["tmf8828"]})
    assert not kept(shipped, {"parts": [path]})
    assert kept(shipped, {"parts": ["vl53l5cx:8x8"]})
    assert not kept(shipped, {"parts": ["vl53l5cx:4x4"]})


# the command line


def test_constrain_snaps_shows_the_losses_and_evaluate_takes_the_design(call, tmp_path):
    run = make_run(tmp_path / "run")
    arguments = ("constrain", run, "--set", "snap=catalog", "--sensors", 2, "--name", "bought")
    shown = call(*arguments)
    assert shown.code == 0, shown.err
    assert "sensors as parts of the catalogue" in shown.out
    document = call(*arguments, "--rays", 20, "--json").json
    assert document["satisfied"]
    assert {row["part"] for row in document["snap"]["sensors"]} <= {part.name for part in load_library().every_mode()}
    design = load_design(Path(document["design"]))
    assert design.constraints["snap"] == "catalog"
    assert [sensor.part for sensor in design.sensors] == [row["part"] for row in document["snap"]["sensors"]]
    assert call("evaluate", run, "--rays", 12, "--set", "test=2", "--set", "train=2", "--json").code == 0


def test_keys_of_the_mapping_may_follow_the_short_form(call, tmp_path):
    run = make_run(tmp_path / "run", count=2000)
    arguments = ("constrain", run, "--sensors", 2, "--set", "snap=catalog", "--set", "gate.width_m.max=0.2")
    refused = call(*arguments, "--json")
    assert refused.code == 4
    assert refused.json["error"]["conflicts"] == ["gate.width_m.max", "snap"]
    kept = call(*arguments, "--set", "snap.otherwise=keep", "--rays", 20, "--json")
    assert kept.code == 0, kept.err
    assert [row["part"] for row in kept.json["snap"]["sensors"]] == [None, None]


def test_a_scan_has_no_sensors_that_could_be_parts(call, tmp_path):
    run = make_run(tmp_path / "run", count=2000)
    refused = call("constrain", run, "--set", "snap=catalog", "--layout", "scan", "--rays", 9)
    assert refused.code == 2
    assert "no part has a single steered ray" in refused.err


def test_more_rays_of_parts_than_a_file_holds_are_refused():
    with pytest.raises(ConfigError, match="at most 60000"):
        snapped(rays=60_001)
