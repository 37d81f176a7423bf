"""YAML is read with positions, without surprises, and never executes anything."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.run.yaml import MAX_DEPTH, dump_yaml, leaves, load_yaml, parse_yaml

PLAIN = [
    ("1e-3", 1e-3),
    ("1.5E+2", 150.0),
    (".5", 0.5),
    ("5.", 5.0),
    ("-7", -7),
    ("+7", 7),
    ("010", 10),
    ("089", 89),
    ("true", True),
    ("False", False),
    ("null", None),
    ("~", None),
    ("no", "no"),
    ("on", "on"),
    ("y", "y"),
    ("1:30", "1:30"),
    ("2020-01-01", "2020-01-01"),
    ("0x1f", "0x1f"),
    ("1_000", "1_000"),
    ("'1'", "1"),
    ('"true"', "true"),
]

BAD = {
    "duplicate key": ("a: 1\nb: 2\na: 3\n", "3:1", "given before, in line 1"),
    "nested duplicate": ("a: {b: 1, b: 2}", "1:11", "given before"),
    "python tag": ("a: !!python/object/apply:os.system [echo hi]", "1:4", "tag"),
    "string tag": ("a: !!str 1", "1:4", "tag"),
    "own tag": ("!thing {a: 1}", "1:1", "tag"),
    "too deep": ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), f"1:{MAX_DEPTH + 1}", "deeply"),
    "far too deep": ("[" * 100_000, f"1:{MAX_DEPTH + 1}", "deeply"),
    "number as key": ("1: a", "1:1", "not text"),
    "null as key": ("~: a", "1:1", "not text"),
    "list as key": ("? [1]\n: 2", "1:3", "cannot be a key"),
    "merge key": ("a: &x {b: 1}\nc:\n  <<: *x", "3:3", "merge"),
    "infinite": ("a: .inf", "1:4", "finite"),
    "not a number": ("a: [1, .NaN]", "1:8", "finite"),
    "overflow": ("a: 1e999", "1:4", "too large"),
    "long integer": ("a: " + "9" * 5000, "1:4", "too long"),
    "self reference": ("a: &x [*x]", "1:8", "alias"),
    "alias": ("a: &x [1]\nb: *x", "2:4", "alias"),
    "unknown alias": ("a: *x", "1:4", "alias"),
    "two documents": ("a: 1\n---\na: 2\n", "2:1", "second document"),
    "unclosed": ("a: [1, 2", "", "not YAML"),
    "colon in text": ("a: b: c", "1:5", "not YAML"),
    "tab": ("a:\n\tb: 1", "2:1", "not YAML"),
    "control character": ("a: \x00", "", "not YAML"),
}


@pytest.mark.hard_case("36")
@pytest.mark.parametrize(("text", "value"), PLAIN)
def test_plain_scalars_mean_what_they_look_like(text, value):
    read = parse_yaml(f"key: {text}", where="f").value["key"]
    assert read == value
    assert type(read) is type(value)


@pytest.mark.hard_case("36")
@pytest.mark.parametrize("case", BAD)
def test_bad_yaml_is_refused_with_its_position(case):
    text, position, words = BAD[case]
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, where="file.yaml")
    assert caught.value.where.startswith(f"file.yaml:{position}" if position else "file.yaml")
    assert words in str(caught.value)


def test_every_value_and_key_has_a_position():
    document = parse_yaml("a: 1\nb:\n  c: [10, 20]\n  d: x\n", where="f")
    assert document.locate(("a",)) == "f:1:4"
    assert document.locate(("a",), key=True) == "f:1:1"
    assert document.locate(("b", "c", 1)) == "f:3:11"
    assert document.locate(("b",)) == "f:2:1"
    assert document.locate(("b", "absent", "deeper")) == "f:2:1"
    assert document.locate(("absent",)) == "f:1:1"


def test_files_that_cannot_be_text_are_refused(tmp_path):
    path = tmp_path / "file.yaml"
    with pytest.raises(ConfigError, match="No such file"):
        load_yaml(path)
    path.write_bytes(b"a: 1\nb: \xff\n")
    with pytest.raises(ConfigError, match=r"file\.yaml:2:1: is not UTF-8"):
        load_yaml(path)
    path.write_bytes(b"a: '" + b"x" * 1_000_000 + b"'")
    with pytest.raises(ConfigError, match="too large"):
        load_yaml(path)
    with pytest.raises(ConfigError, match="it is a folder"):
        load_yaml(tmp_path)


def test_a_byte_order_mark_and_windows_line_ends_are_fine(tmp_path):
    path = tmp_path / "file.yaml"
    path.write_bytes("\ufeffa: 1\r\nb: [2,\r\n 3]\r\n".encode())
    assert load_yaml(path).value == {"a": 1, "b": [2, 3]}


def test_an_empty_file_is_an_empty_mapping_and_a_list_is_none():
    assert parse_yaml("# nothing\n", where="f").mapping == {}
    with pytest.raises(ConfigError, match="keys and values"):
        _ = parse_yaml("[1]", where="f").mapping


scalars = st.none() | st.booleans() | st.integers(-(10**18), 10**18) | st.floats(allow_nan=False, allow_infinity=False)
printable = st.text(
    st.characters(exclude_categories=["Cs", "Cc"], exclude_characters="\ufeff\ufffe\uffff\u2028\u2029\x85")
)
awkward = st.sampled_from(
    ["no", "1e-3", "010", "089", "1:30", "~", "", "null", "2020-01-01", "0x1f", ".inf", "<<", "-", "#"]
)
texts = printable | awkward
documents = st.recursive(
    scalars | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=12,
)


@given(documents)
def test_written_values_are_read_back_exactly(value):
    read = parse_yaml(dump_yaml({"value": value}), where="f").value["value"]
    assert repr(read) == repr(value)


@given(documents)
def test_written_values_mean_the_same_to_other_readers(value):
    assert yaml.safe_load(dump_yaml({"value": value}))["value"] == value


def test_numpy_values_and_tuples_are_written_as_plain_ones():
    text = dump_yaml({"a": np.float64(0.1), "b": np.arange(3), "c": (1, 2), "d": np.bool_(True)})
    assert parse_yaml(text, where="f").value == {"a": 0.1, "b": [0, 1, 2], "c": [1, 2], "d": True}


@pytest.mark.parametrize("value", [math.nan, math.inf, np.array([1.0, -np.inf])])
def test_numbers_that_are_not_finite_are_never_written(value):
    with pytest.raises(NumericalError, match="a"):
        dump_yaml({"a": {"b": value}})


def test_leaves_name_every_scalar():
    value = {"a": [1, {"b": 2}], "c": {}, "d": None}
    assert dict(leaves(value)) == {("a", 0): 1, ("a", 1, "b"): 2, ("c",): {}, ("d",): None}
