"""The design file: exact round trips, files written by hand, and errors that point at line and column."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import conditions, length, patterns, sensors

from lidardesign.api.config_reference import schema_of
from lidardesign.errors import ConfigError, NumericalError
from lidardesign.formats.designs import load_design
from lidardesign.run.inputs import DESIGN
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import COLUMNS, MOST_FILE_RAYS, design_document, design_from_document, save_design
from lidardesign.sensors.pattern import Pattern

EXAMPLE = Path(__file__).parents[2] / "examples" / "hand_written_design.yaml"
DOCS = Path(__file__).parents[2] / "docs" / "design-file.md"
SCHEMA = schema_of("design")

anything = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)))
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc"))).filter(str.strip)


@st.composite
def designs(draw):
    names = draw(st.lists(words, min_size=1, max_size=4, unique=True))
    raw = np.array(draw(st.lists(st.floats(0.01, 1), min_size=len(names), max_size=len(names))))
    layout = draw(st.sampled_from(["chosen", "even", "spinning", "fixed"]))
    numbers = sorted(draw(st.sets(st.integers(1, 6), min_size=1, max_size=3 if layout == "chosen" else 1)))
    dimension = draw(st.none() | conditions)
    tables = () if layout == "even" else tuple(draw(patterns(len(names), n, dimension)) for n in numbers)
    return DesignSpec(
        name=draw(words), layout=layout, patterns=tables, level=draw(st.floats(0.01, 0.999999)),
        sensors=tuple(draw(sensors(name, float(share))) for name, share in zip(names, raw / raw.sum(), strict=True)),
        mount=draw(st.sampled_from([None, "torso"])),
        at=draw(st.dictionaries(st.sampled_from(["x_m", "y_m", "azimuth_rad"]), st.floats(-1e9, 1e9))),
        constraints={"gate": {"width_m": {"max": draw(length)}}},
        certificates=tuple(draw(st.lists(st.just({"rays": 7, "gap": 0.25}), max_size=2))),
        provenance={"command": draw(anything), "seed": 7},
    )  # fmt: skip


def same(first, second):
    """Whether two values of a dataclass are equal to the last bit."""
    if isinstance(first, np.ndarray):
        return isinstance(second, np.ndarray) and first.dtype == second.dtype and np.array_equal(first, second)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    if hasattr(first, "__dataclass_fields__"):
        return all(same(getattr(first, name), getattr(second, name)) for name in first.__dataclass_fields__)
    return first == second


@given(design=designs())
def test_what_is_written_is_read_back_to_the_last_bit_and_follows_the_schema(design):
    text = dump_yaml(design_document(design))
    document = parse_yaml(text, where="design.yaml")
    jsonschema.validate(document.value, SCHEMA)
    loaded = design_from_document(document.value, locate=document.locate)
    assert same(loaded, design)
    assert dump_yaml(design_document(loaded)) == text
    assert same(design_from_document(json.loads(json.dumps(design_document(design)))), design)


def test_a_saved_design_is_loaded_under_the_name_of_its_file(tmp_path):
    design = load_design(EXAMPLE)
    path = tmp_path / "folder with spaces" / "größe.yaml"
    save_design(design, path)
    assert same(load_design(path), replace(design, name="größe"))
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("changes", [{"azimuth_rad": math.nan}, {"gate_m": (0.1, math.inf)}])
def test_a_design_with_numbers_that_are_not_finite_is_not_written(tmp_path, changes):
    design = load_design(EXAMPLE)
    broken = replace(design, sensors=(replace(design.sensors[0], **changes),))
    with pytest.raises(NumericalError):
        save_design(broken, tmp_path / "broken.yaml")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("knots", "count"), [(1, MOST_FILE_RAYS + 1), (MOST_FILE_RAYS // 2 + 1, 2)])
def test_more_rays_than_can_be_read_back_are_not_written(tmp_path, knots, count):
    flat, gate = np.zeros((knots, count)), np.ones((knots, count, 2))
    pattern = Pattern(np.zeros((knots, count, 3)), flat, flat, gate, np.zeros(count, int), None, ())
    with pytest.raises(ConfigError, match=r"6000[12] rays"):
        save_design(replace(load_design(EXAMPLE), layout="fixed", patterns=(pattern,)), tmp_path / "x.yaml")
    assert not list(tmp_path.iterdir())


def test_as_many_rays_as_can_be_written_fit_into_what_is_read(tmp_path):
    count = MOST_FILE_RAYS // 20
    # numbers of all digits
    origin_m, angles_rad, gate_m = (np.random.default_rng(0).uniform(-1.5, -1, (count, size)) for size in (3, 2, 2))
    rays = Rays.from_angles(origin_m, *angles_rad.T, np.sort(gate_m + 2), np.zeros(count))
    design = replace(load_design(EXAMPLE), layout="fixed", patterns=(Pattern.of(rays),))
    save_design(design, tmp_path / "x.yaml")
    assert same(load_design(tmp_path / "x.yaml").patterns, design.patterns)
    assert 20 * (tmp_path / "x.yaml").stat().st_size < DESIGN.most_bytes


# --- written by hand


def test_the_example_written_by_hand_loads_and_gives_its_rays():
    design = load_design(EXAMPLE)
    jsonschema.validate(parse_yaml(EXAMPLE.read_text(), where="x").value, SCHEMA)
    assert np.bincount(design.rays().sensor).tolist() == [40, 60]
    assert design.sensors[0].gate_m == (0.25, 0.40)
    assert design.sensors[1].field_of_view_rad == (0.45, 0.40)


def test_every_design_in_the_documentation_loads_and_follows_the_schema():
    blocks = [part.split("```")[0] for part in DOCS.read_text(encoding="utf-8").split("```yaml\n")[1:]]
    whole = [block for block in blocks if "schema_version" in block]
    assert whole
    for block in whole:
        document = parse_yaml(block, where="docs/design-file.md")
        jsonschema.validate(document.value, SCHEMA)
        design_from_document(document.value, locate=document.locate)


HAND_WRITTEN = """\
schema_version: 2
sensors:
- origin_m: {mean: [0, 0, 1]}
  boresight: {azimuth_rad: 0, elevation_rad: -1.5707963267948966}
  field_of_view_rad: {horizontal: 0.4, vertical: 0.2}
  gate_m: {start: 0.5, end: 1.5}
"""


def hand_written(*sensors):
    """The document of sensors that differ from one in some keys."""
    document = parse_yaml(HAND_WRITTEN, where="x").value
    return {**document, "sensors": [{**document["sensors"][0], **sensor} for sensor in sensors or ({},)]}


def test_defaults_are_even_rays_of_any_number_from_one_place():
    design = design_from_document(hand_written(), "mine.yaml")
    (only,) = design.sensors
    assert (design.name, design.layout, design.count, design.level) == ("mine", "even", None, 0.95)
    assert (only.name, only.weight, only.roll_rad, only.origin_covariance_m2) == ("sensor_1", 1.0, 0.0, None)


@pytest.mark.parametrize(
    ("weights", "shares"),
    [((None, None), [0.5, 0.5]), ((3, 1), [0.75, 0.25]), ((0, 2), [0, 1]), ((1e-300, 3e-300), [0.25, 0.75])],
)
def test_weights_are_shares_in_proportion(weights, shares):
    document = hand_written(*({} if weight is None else {"weight": weight} for weight in weights))
    assert [sensor.weight for sensor in design_from_document(document).sensors] == pytest.approx(shares)


def test_keys_that_may_be_left_out_may_be_null():
    document = hand_written({"weight": None, "name": None, "part": None})
    optional = ("name", "layout", "level", "patterns", "at", "mount", "constraints", "certificates", "provenance")
    expected = design_from_document(hand_written())
    assert same(design_from_document({**document, **dict.fromkeys(optional)}), expected)


# --- refused

GOOD = """\
schema_version: 2
layout: chosen
sensors:
- name: one
  weight: 1.0
  origin_m: {mean: [0, 0, 1], covariance: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
  boresight: {azimuth_rad: 0, elevation_rad: -1.5}
  field_of_view_rad: {horizontal: 0.4, vertical: 0.2}
  gate_m: {start: 0.5, end: 1.5}
patterns:
- dimension: x_m
  knots_m: [0, 1]
  origin_x_m: [[0, 0], [1, 1]]
  origin_y_m: [[0, 0], [0, 0]]
  origin_z_m: [[1, 1], [1, 1]]
  azimuth_rad: [[0, 0.1], [0, 0.1]]
  elevation_rad: [[0, 0.2], [0, 0.2]]
  gate_start_m: [[0.5, 0.6], [0.5, 0.6]]
  gate_end_m: [[1.0, 1.1], [1.0, 1.1]]
  sensor: [0, 0]
at: {x_m: 0.5}
mount: {body: torso}
constraints: {gate: {width_m: {max: 2}}}
"""
BAD = [
    # the version
    ("schema_version: 2", "schema_version: 3", ":1:17", "a newer version"),
    ("schema_version: 2", "schema_version: true", ":1:17", "allowed: 2"),
    ("schema_version: 2\n", "", ":1:1", "schema_version is missing"),
    # keys, and values of the wrong kind
    ("layout: chosen", "layout: gird", ":2:9", "'chosen', 'even', 'spinning' or 'fixed'"),
    ("layout: chosen", "layuot: chosen", ":2:1", "did you mean 'layout'"),
    ("layout: chosen", "layout: chosen\nlevel: 1.0", ":3:8", "0.999999"),
    ("name: one", "name: 3", ":4:9", "string"),
    ("name: one", "name: ' '", ":4:9", "blank"),
    ("weight: 1.0", "weight: -1", ":5:11", "greater than or equal to 0"),
    ("weight: 1.0", "weight: 0", ":1:1", "zero"),
    ("weight: 1.0", "weight: true", ":5:11", "True"),
    ("weight: 1.0", "weight: .nan", ":5:11", "finite"),
    ("weight: 1.0", "weight: 1e999", ":5:11", "too large"),
    ("mount: {body: torso}", "mount: torso", ":22:8", "keys and values"),
    ("mount: {body: torso}", "mount: {body: ''}", ":22:15", "blank"),
    ("at: {x_m: 0.5}", "at: {speed: 1}", ":21:", "'x_m', 'y_m', 'z_m'"),
    ("at: {x_m: 0.5}", "at: {x_m: here}", ":21:11", "number"),
    ("constraints: {gate: {width_m: {max: 2}}}", "constraints: 3", ":23:14", "dictionary"),
    # sensors
    ("sensors:", "sensors: []\nx:", ":4:1", "unknown"),
    ("mean: [0, 0, 1]", "mean: [0, 0]", ":6:20", "3 items"),
    ("mean: [0, 0, 1]", "mean: [0, 0, x]", ":6:27", "number"),
    ("mean: [0, 0, 1]", "mean: [0, 0, 1e10]", ":6:27", "1000000000"),
    ("mean: [0, 0, 1], ", "", ":6:", "mean is missing"),
    ("[0, 1, 0]", "[0.5, 1, 0]", ":6:", "symmetric"),
    ("[0, 1, 0]", "[0, -1, 0]", ":6:", "eigenvalue"),
    ("[0, 1, 0], ", "", ":6:", "3 items"),
    ("elevation_rad: -1.5", "elevation_rad: -15", ":7:46", "-1.57"),
    ("vertical: 0.2", "vertical: 7", ":8:50", "6.28"),
    ("start: 0.5, end", "start: -0.5, end", ":9:19", "greater than or equal to 0"),
    ("start: 0.5, end", "start: 1.5, end", ":9:", "not beyond the start 1.5"),
    ("  gate_m: {start: 0.5, end: 1.5}\n", "", ":4:", "gate_m is missing"),
    # patterns
    ("layout: chosen", "layout: even", ":1:1", "no pattern"),
    ("dimension: x_m", "dimension: range_m", ":11:14", "'x_m', 'y_m' or 'z_m'"),
    ("- dimension: x_m\n  knots", "- knots", ":11:", "knots_m"),
    ("  knots_m: [0, 1]\n", "", ":11:", "knots_m"),
    ("knots_m: [0, 1]", "knots_m: [1]", ":11:", "at least two"),
    ("knots_m: [0, 1]", "knots_m: [1, 1]", ":11:", "ascend"),
    ("knots_m: [0, 1]", "knots_m: [0, 1e10]", ":12:16", "1000000000"),
    ("origin_y_m: [[0, 0], [0, 0]]", "origin_y_m: [[0, 0], [0]]", ":11:", "2 rows of 2"),
    ("origin_y_m: [[0, 0], [0, 0]]", "origin_y_m: [0, 0]", ":14:16", "list"),
    ("[[0, 0.2], [0, 0.2]]", "[[0, 2.0], [0, 0.2]]", ":17:23", "1.57"),
    ("[[0, 0.2], [0, 0.2]]", "[[0, '0.2'], [0, 0.2]]", ":17:23", "number"),
    ("gate_end_m: [[1.0, 1.1]", "gate_end_m: [[1.0, 0.6]", ":11:", "ray 1 ends at 0.6 m"),
    ("sensor: [0, 0]", "sensor: [0, 1]", ":1:1", "beyond the last of 1"),
    ("sensor: [0, 0]", "sensor: [0, -1]", ":20:15", "greater than or equal to 0"),
    ("sensor: [0, 0]", "sensor: [0, 0.0]", ":20:15", "integer"),
    ("sensor: [0, 0]", "sensor: []", ":11:", "rows of 0"),
    ("sensor: [0, 0]", "sensor: [0, 0]\n  speed: 1", ":21:3", "unknown"),
]


@pytest.mark.parametrize(("old", "new", "position", "says"), BAD)
def test_a_bad_file_is_refused_with_its_position_and_what_is_allowed(tmp_path, old, new, position, says):
    path = tmp_path / "bad.yaml"
    assert GOOD.count(old) == 1
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_design(path)
    assert caught.value.exit_code == 2
    assert f"bad.yaml{position}" in str(caught.value)
    assert says in str(caught.value)


@pytest.mark.parametrize("version", [1, 0, -3])
def test_a_design_of_an_earlier_version_gets_one_sentence_whatever_else_it_says(tmp_path, version):
    earlier = "layout: density\nrays: 10\nray_table: {gate_end_m: [1]}\nsensors: [{range_m: 1, spread: {}}]\n"
    (tmp_path / "old.yaml").write_text(f"schema_version: {version}\n{earlier}")
    with pytest.raises(ConfigError, match="an earlier version") as caught:
        load_design(tmp_path / "old.yaml")
    assert (caught.value.exit_code, caught.value.where) == (2, f"{tmp_path / 'old.yaml'}:1:17")
    assert "fit" in caught.value.hint


@pytest.mark.parametrize(
    ("sensors", "words"),
    [
        (({"name": "a"}, {"name": "a"}), "the name 'a'"),
        (({"weight": 1}, {}), "all weights or none"),
        (({"weight": 1e308}, {"weight": 1e308}), "too large to sum"),
    ],
)
def test_sensors_that_contradict_each_other_are_refused(sensors, words):
    with pytest.raises(ConfigError, match=words):
        design_from_document(hand_written(*sensors))


def still(count):
    """A pattern of so many rays without a condition."""
    numbers = {**dict.fromkeys(COLUMNS, 0.5), "gate_end_m": 1.5}
    return {**{key: [[number] * count] for key, number in numbers.items()}, "sensor": [0] * count}


MOVING = parse_yaml(GOOD, where="x").value["patterns"][0]


@pytest.mark.parametrize(
    ("layout", "tables", "words"),
    [
        ("fixed", (), "at least one pattern"),
        ("chosen", (), "at least one pattern"),
        ("fixed", (still(1), still(2)), "need the layout chosen"),
        ("spinning", (still(1), still(2)), "need the layout chosen"),
        ("chosen", (still(2), still(1)), "ascending"),
        ("chosen", (still(2), still(2)), "ascending"),
        ("chosen", (still(1), MOVING), "different conditions"),
    ],
)
def test_patterns_that_contradict_their_layout_or_each_other_are_refused(layout, tables, words):
    with pytest.raises(ConfigError, match=words):
        design_from_document({**hand_written(), "layout": layout, "patterns": list(tables)})


@pytest.mark.parametrize("content", ["", "[]", "just text", "a: 1", "sensors: []\nschema_version: 2\n"])
def test_a_file_that_is_no_design_is_refused(tmp_path, content):
    path = tmp_path / "other.yaml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"other\.yaml"):
        load_design(path)
