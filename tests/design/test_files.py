"""The design file: exact round trips, files written by hand, and errors that point at line and column."""

import json
import math
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lidardesign.layouts.rays import gates_of, lay_out
from support.strategies import finite, length, sensors, width
from support.tables import each_row

from lidardesign.errors import ConfigError, DataError, NumericalError
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design_file import (
    SCHEMA_FILE,
    design_document,
    design_from_document,
    load_design,
    save_design,
)
from lidardesign.sensors.sensor import DesignSpec, interval_factor

EXAMPLE = Path(__file__).parents[2] / "examples" / "hand_written_design.yaml"
DOCS = Path(__file__).parents[2] / "docs" / "design-file.md"
SCHEMA = json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))

anything = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)))
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc"))).filter(str.strip)


@st.composite
def ray_tables(draw, sensor_count):
    count = draw(st.integers(1, 12))
    column = lambda values: np.array(draw(st.lists(values, min_size=count, max_size=count)), dtype=np.float64)  # noqa: E731
    start = column(length)
    return Rays.from_angles(
        origin_m=np.stack([column(finite) for _ in range(3)], axis=1),
        azimuth_rad=column(st.floats(-10, 10)),
        elevation_rad=column(st.floats(-math.pi / 2, math.pi / 2)),
        gate_m=np.stack([start, start + column(width)], axis=1),
        sensor=column(st.integers(0, sensor_count - 1)).astype(np.int64),
    )


@st.composite
def designs(draw):
    names = draw(st.lists(words, min_size=1, max_size=4, unique=True))
    level = draw(st.floats(0.01, 0.999999))
    raw = np.array(draw(st.lists(st.floats(0.01, 1), min_size=len(names), max_size=len(names))))
    shares = raw / raw.sum()
    own = draw(st.booleans())
    counts = draw(st.lists(st.integers(1, 9), min_size=len(names), max_size=len(names)))
    table = draw(st.none() | ray_tables(len(names))) if not own else None
    total = sum(counts) if own else len(table.sensor) if table is not None else draw(st.none() | st.integers(1, 999))
    chosen = tuple(
        draw(sensors(name, float(share), level, rays if own else None))
        for name, share, rays in zip(names, shares, counts, strict=True)
    )
    return DesignSpec(
        name=draw(words), sensors=chosen, rays=total, ray_table=table, level=level,
        layout=draw(st.sampled_from(["grid", "density", "scan", "distributed"])),
        gates=None if table is not None else draw(st.sampled_from([None, "sensor", "ray"])),
        mount=draw(st.sampled_from([None, "torso"])),
        at=draw(st.dictionaries(st.sampled_from(["x_m", "y_m", "z_m", "azimuth_rad"]), st.floats(-1e9, 1e9))),
        constraints={"gate": {"width_m": {"max": draw(length)}}},
        provenance={"command": draw(anything), "seed": 7},
    )  # fmt: skip


def same(first, second):
    """Whether two values of a dataclass are equal to the last bit."""
    if isinstance(first, np.ndarray):
        return first.dtype == second.dtype and np.array_equal(first, second)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    if hasattr(first, "__dataclass_fields__"):
        return all(same(getattr(first, name), getattr(second, name)) for name in first.__dataclass_fields__)
    return first == second


def test_gates_are_written_where_the_rays_do_not_tell_of_them():
    sensor = load_design(EXAMPLE).sensors[0]
    gates = np.array([[0.1, 0.2], [0.1, 0.3]])
    zeros = np.zeros(2)
    two = Rays.from_angles(np.zeros((2, 3)), zeros, zeros, gates, zeros)
    for table, written in ((two, False), (two.subset(np.array([0])), True), (None, True)):
        document = design_document(DesignSpec("d", (sensor,), gates="ray", ray_table=table))
        assert ("gates" in document) == written
        assert gates_of(design_from_document(document)) == "ray"


@settings(max_examples=60, deadline=None)
@given(design=designs())
def test_what_is_written_is_read_back_to_the_last_bit_and_follows_the_schema(design):
    text = dump_yaml(design_document(design))
    document = parse_yaml(text, where="design.yaml")
    jsonschema.validate(document.value, SCHEMA)
    assert same(design_from_document(document.value, locate=document), design)
    assert same(design_from_document(json.loads(json.dumps(design_document(design)))), design)


def test_a_saved_design_is_loaded_under_the_name_of_its_file(tmp_path):
    design = design_from_document(design_document(load_design(EXAMPLE)))
    path = tmp_path / "folder with spaces" / "größe.yaml"
    save_design(design, path)
    assert same(load_design(path), replace(design, name="größe"))
    assert list(path.parent.iterdir()) == [path]


def test_the_schema_is_a_valid_schema():
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


# --- written by hand


def test_the_example_written_by_hand_loads_and_gives_its_rays():
    design = load_design(EXAMPLE)
    jsonschema.validate(parse_yaml(EXAMPLE.read_text(), where="x").value, SCHEMA)
    rays = lay_out(design)
    assert len(rays) == 100
    assert np.bincount(rays.sensor).tolist() == [40, 60]
    np.testing.assert_allclose(design.sensors[0].gate_m, (0.25, 0.40), atol=1e-15)
    np.testing.assert_allclose(design.sensors[1].field_of_view_rad, (0.45, 0.40), atol=1e-15)


def test_every_design_in_the_documentation_loads_and_follows_the_schema():
    blocks = [part.split("```")[0] for part in DOCS.read_text(encoding="utf-8").split("```yaml\n")[1:]]
    whole = [block for block in blocks if "schema_version" in block]
    assert whole
    for block in whole:
        document = parse_yaml(block, where="docs/design-file.md")
        jsonschema.validate(document.value, SCHEMA)
        design_from_document(document.value, locate=document)


def hand_written(**changes):
    sensor = {
        "origin_m": {"mean": [0, 0, 1]},
        "boresight": {"azimuth_rad": 0, "elevation_rad": -1.5707963267948966},
        "field_of_view_rad": {"horizontal": 0.4, "vertical": 0.2},
        "gate_m": {"start": 0.5, "end": 1.5},
    }
    merged = {**sensor, **changes}
    return {"schema_version": 1, "sensors": [{k: v for k, v in merged.items() if v is not None}]}


def test_defaults_are_a_grid_of_one_fixed_sensor_with_every_ray():
    design = design_from_document(hand_written(), "mine.yaml")
    only = design.sensors[0]
    assert (design.name, design.layout, design.rays, design.level) == ("mine", "grid", None, 0.95)
    assert (only.name, only.weight, only.roll_rad, only.rays) == ("sensor_1", 1.0, 0.0, None)
    assert (only.origin_covariance_m2 == 0).all()


@settings(max_examples=100, deadline=None)
@given(
    level=st.floats(0.05, 0.999),
    start=st.floats(0, 10),
    width=st.floats(1e-3, 10),
    field=st.floats(1e-3, 6.28),
)
def test_intervals_alone_give_the_spreads_and_come_back(level, start, width, field):
    document = hand_written(
        gate_m={"start": start, "end": start + width},
        field_of_view_rad={"horizontal": field, "vertical": field / 2},
    )
    design = design_from_document({**document, "level": level})
    sensor = design.sensors[0]
    assert sensor.gate_m == pytest.approx((start, start + width), rel=1e-12, abs=1e-12)
    assert sensor.field_of_view_rad == pytest.approx((field, field / 2), rel=1e-12)
    assert sensor.spread_horizontal_rad == pytest.approx(field / 2 / interval_factor(level), rel=1e-12)
    assert same(design_from_document(design_document(design)), design)


def test_the_spread_alone_is_enough_and_agrees_with_its_own_intervals():
    spread = {"horizontal_rad": 0.1, "vertical_rad": 0.05, "range_m": 0.2}
    alone = design_from_document(hand_written(field_of_view_rad=None, gate_m=None, range_m=1.0, spread=spread))
    written = design_document(alone)["sensors"][0]
    both = design_from_document(
        hand_written(
            field_of_view_rad=written["field_of_view_rad"],
            gate_m=written["gate_m"],
            range_m=1.0,
            spread=spread,
        )
    )
    assert same(alone, both)


def test_a_gate_that_starts_at_the_sensor_keeps_the_mean_that_was_given():
    document = hand_written(range_m=0.1, gate_m={"start": 0.0, "end": 0.1 + 0.3 * interval_factor(0.95)})
    sensor = design_from_document(document).sensors[0]
    assert (sensor.range_m, sensor.spread_range_m) == (0.1, pytest.approx(0.3))


def test_weights_are_shares_in_proportion():
    document = hand_written()
    two = [{**document["sensors"][0], "name": name} for name in "ab"]
    assert [s.weight for s in design_from_document({**document, "sensors": two}).sensors] == [0.5, 0.5]
    weighted = [{**s, "weight": w} for s, w in zip(two, (3, 1), strict=True)]
    assert [s.weight for s in design_from_document({**document, "sensors": weighted}).sensors] == [0.75, 0.25]


# --- refused

GOOD = """\
schema_version: 1
layout: grid
rays: 10
sensors:
- name: one
  weight: 1.0
  origin_m: {mean: [0, 0, 1], covariance: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
  boresight: {azimuth_rad: 0, elevation_rad: -1.5}
  field_of_view_rad: {horizontal: 0.4, vertical: 0.2}
  gate_m: {start: 0.5, end: 1.5}
"""
TABLE = """\
ray_table:
  origin_x_m: [0, 0]
  origin_y_m: [0, 0]
  origin_z_m: [0, 0]
  azimuth_rad: [0, 1]
  elevation_rad: [0, 1]
  gate_start_m: [0, 1]
  gate_end_m: [1, 2]
  sensor: [0, 0]
"""
BAD = [
    ("layout: grid", "layout: gird", ":2:9", "grid or density or scan"),
    ("layout: grid", "layuot: grid", ":2:", "layout"),
    ("rays: 10", "rays: 10.5", ":3:7", "whole number"),
    ("rays: 10", "rays: -1", ":3:7", "from 1"),
    ("rays: 10", "rays: 0", ":3:7", "from 1"),
    ("rays: 10", "rays: yes", ":3:7", "whole number"),
    ("rays: 10", "rays: true", ":3:7", "whole number"),
    ("schema_version: 1", "schema_version: 2", ":1:17", "newer version"),
    ("schema_version: 1", "schema_version: true", ":1:17", "is True"),
    ("schema_version: 1\n", "", ":1:", "schema_version"),
    ("weight: 1.0", "weight: -1", ":6:11", "at least 0"),
    ("weight: 1.0", "weight: 0", ":4:", "sum"),
    ("weight: 1.0", "wieght: 1", ":6:", "weight"),
    ("weight: 1.0", "weight: abc", ":6:11", "'abc'"),
    ("weight: 1.0", "weight: .nan", ":6:11", "finite"),
    ("name: one", "name: 3", ":5:9", "text"),
    ("mean: [0, 0, 1]", "mean: [0, 0]", ":7:", "2 numbers"),
    ("mean: [0, 0, 1]", "mean: [0, 0, x]", ":7:27", "number"),
    ("mean: [0, 0, 1], ", "", ":7:", "`mean`"),
    ("[0, 1, 0]", "[0.5, 1, 0]", ":7:", "symmetric"),
    ("[0, 1, 0]", "[0, -1, 0]", ":7:", "eigenvalue"),
    ("[0, 1, 0], ", "", ":7:", "3 rows"),
    ("elevation_rad: -1.5", "elevation_rad: -15", ":8:46", "1.5708"),
    ("elevation_rad: -1.5", "elevation_deg: -15", ":8:", "elevation_rad"),
    ("vertical: 0.2", "vertical: 7", ":9:50", "6.28"),
    (", vertical: 0.2", "", ":5:", "vertical"),
    ("start: 0.5", "start: -0.5", ":10:19", "from 0 to 1e+09"),
    ("start: 0.5", "start: 1.5", ":10:29", "not beyond the gate's start 1.5"),
    ("start: 0.5", "start: 2.5", ":10:", "not beyond the gate's start"),
    ("  gate_m: {start: 0.5, end: 1.5}\n", "", ":5:", "no gate"),
    ("end: 1.5}", "end: 1.5}\n  spread: {range_m: 0.5}\n  range_m: 1.0", ":10:", "the spread gives"),
    ("end: 1.5}", "end: 1.5}\n  spread: {horizontal_rad: 0.5}", ":9:", "the spread gives"),
    ("end: 1.5}", "end: 1.5}\n  range_m: 0.9", ":10:", "the spread gives"),
    ("end: 1.5}", "end: 1.5}\n  rays: 11", ":3:", "contradicts"),
    ("sensors:", "sensors: []\nx:", ":5:", "unknown"),
    ("rays: 10", "rays: 10\nrays: 11", ":4:1", "given before"),
    ("rays: 10", "rays: [10", ":", "YAML"),
    ("rays: 10", "rays: !!python/object:os.system 1", ":3:7", "tag"),
    ("rays: 10\n", "level: 1.0\n", ":3:8", "0.999999"),
    ("rays: 10\n", "constraints: 3\n", ":3:14", "mapping"),
    ("rays: 10\n", TABLE.replace("sensor: [0, 0]", "sensor: [0, 1]"), ":11:15", "whole number"),
    (
        "rays: 10\n",
        TABLE.replace("gate_end_m: [1, 2]", "gate_end_m: [1, 0.5]"),
        ":10:19",
        "not beyond the gate's start",
    ),
    ("rays: 10\n", TABLE.replace("origin_x_m: [0, 0]", "origin_x_m: [0]"), ":4:", "1 numbers"),
    ("rays: 10\n", "rays: 3\n" + TABLE, ":3:", "contradicts"),
]


@each_row(("old", "new", "position", "says"), BAD)
def test_a_bad_file_is_refused_with_its_position_and_what_is_allowed(tmp_path, old, new, position, says):
    path = tmp_path / "bad.yaml"
    assert GOOD.count(old) == 1
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_design(path)
    assert caught.value.exit_code == 2
    assert f"bad.yaml{position}" in str(caught.value)
    assert says in str(caught.value)


def test_the_good_file_of_the_table_of_bad_ones_is_good(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text(GOOD)
    assert load_design(path).rays == 10
    path.write_text(GOOD.replace("rays: 10\n", TABLE))
    assert len(lay_out(load_design(path))) == 2


@settings(max_examples=100, deadline=None)
@given(
    at=st.integers(0, len(GOOD) - 1),
    length=st.integers(0, 12),
    insert=st.text("[]{}:,-#&*!|>'\"%@ \n\t0a.é", max_size=4),
)
def test_a_damaged_file_is_read_or_refused_but_never_crashes(tmp_path_factory, at, length, insert):
    path = tmp_path_factory.getbasetemp() / "damaged.yaml"
    path.write_text(GOOD[:at] + insert + GOOD[at + length :], encoding="utf-8")
    try:
        design = load_design(path)
    except (ConfigError, DataError) as error:
        design, message = None, str(error)
    if design is None:
        assert "damaged.yaml" in message
    else:
        assert same(design_from_document(design_document(design)), design)


@each_row("content", ["", "[]", "3", "just text", "a: 1", "sensors: []\nschema_version: 1\n"])
def test_a_file_that_is_no_design_is_refused(tmp_path, content):
    path = tmp_path / "other.yaml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"other\.yaml"):
        load_design(path)


def test_two_sensors_of_one_name_are_refused():
    sensor = hand_written()["sensors"][0]
    with pytest.raises(ConfigError, match="name"):
        design_from_document({"schema_version": 1, "sensors": [{**sensor, "name": "a"}] * 2})


def test_a_missing_file_and_a_folder_are_bad_data(tmp_path):
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(DataError, match="cannot be read") as caught:
            load_design(path)
        assert caught.value.exit_code == 3


def test_a_design_with_numbers_that_are_not_finite_is_not_written(tmp_path):
    design = load_design(EXAMPLE)
    broken = replace(design, sensors=(replace(design.sensors[0], range_m=math.nan),))
    with pytest.raises(NumericalError):
        save_design(broken, tmp_path / "broken.yaml")
    assert not list(tmp_path.iterdir())


def test_the_file_has_one_level_and_the_sensors_keep_their_spreads():
    design = load_design(EXAMPLE)
    other = replace(design, level=0.8, rays=np.int64(100))
    loaded = design_from_document(json.loads(json.dumps(design_document(other))))
    assert {sensor.level for sensor in loaded.sensors} == {0.8}
    spreads = [sensor.spread_horizontal_rad for sensor in design.sensors]
    assert [sensor.spread_horizontal_rad for sensor in loaded.sensors] == spreads


def test_more_explicit_rays_than_can_be_read_back_are_not_written(tmp_path):
    design, count = load_design(EXAMPLE), 60_001
    flat = np.zeros(count)
    table = Rays.from_angles(np.zeros((count, 3)), flat, flat, np.tile([0.0, 1.0], (count, 1)), flat.astype(np.int64))
    with pytest.raises(ConfigError, match="60001 explicit rays"):
        save_design(replace(design, layout="density", rays=count, ray_table=table), tmp_path / "x.yaml")
    assert not list(tmp_path.iterdir())
