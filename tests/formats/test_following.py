"""Exports of patterns that follow what they see, read by numpy alone and by the code that the page gives."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.exports import write_as
from support.rigs import rig
from support.strategies import adaptive_designs

from lidardesign.errors import ConfigError
from lidardesign.formats import FORMATS
from lidardesign.formats.ray_lists import ray_columns
from lidardesign.scenes.rays import Outcome, Returns
from lidardesign.sensors.adaptive import AdaptivePatterns, PatternRule

PAGE = Path(__file__).parents[2] / "docs" / "adaptive.md"


def exported(design, name, folder):
    path = folder / f"follow.{name}"
    write_as(name, design, design.adaptive.patterns[0].at(), path)
    return path


@given(design=adaptive_designs(), data=st.data())
def test_the_code_of_the_page_fires_what_we_fire(tmp_path_factory, design, data):
    folder = tmp_path_factory.mktemp("export")
    exported(design, "npz", folder)
    code = re.search(r"```python\n(# follow.py.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)
    theirs: dict = {}
    exec(code.replace("follow.npz", str(folder / "follow.npz")), theirs)
    with theirs["table"] as arrays:
        theirs["table"] = dict(arrays)
    rays, rule = design.adaptive.rays(), design.adaptive.rule
    range_m = np.array(
        data.draw(st.lists(st.floats(0.1, 9) | st.just(np.nan), min_size=rule.looks, max_size=rule.looks))
    )
    fired = []

    def fire(table):
        fired.append(table)
        return range_m[: len(table)] if len(fired) == 1 else np.full(len(table), 1.0)

    if rule.looks:
        theirs["frame"](fire)
        seen = np.full(len(rays[0]), np.nan)
        seen[: rule.looks] = range_m
        outcome = np.where(np.isnan(seen), Outcome.MISS, Outcome.RETURN)
        returns = [[Returns(one, outcome, seen, np.where(np.isnan(seen), -1, 0))] for one in rays]
        (pattern,) = rays.fired(None, returns)
    else:
        features = np.array(data.draw(st.lists(st.floats(-9, 9) | st.just(np.nan), min_size=2, max_size=2)))
        pattern = rule.pattern_of(features)
        assert theirs["pattern_of"](features) == pattern
        fired = [theirs["rays_of"](pattern)]
    ours = ray_columns(rays[pattern])
    np.testing.assert_array_equal(np.concatenate(fired), np.stack([ours[name] for name in theirs["COLUMNS"]], axis=1))


@given(design=adaptive_designs())
def test_a_csv_has_the_rays_and_the_rule_to_the_last_bit(tmp_path_factory, design):
    folder = tmp_path_factory.mktemp("export")
    with np.load(exported(design, "npz", folder)) as arrays:
        table = dict(arrays)
    text = exported(design, "csv", folder).read_text(encoding="utf-8").splitlines()
    header, *body = [line for line in text if not line.startswith("#")]
    columns = dict(zip(header.split(","), np.array([line.split(",") for line in body], dtype=float).T, strict=True))
    assert all(np.array_equal(values, table[name]) for name, values in columns.items())
    rule = {name: [] for name in ("looks", "missing_m", "centroids")}
    for line in text[1 + len(body) :]:
        name, values = line.removeprefix("# ").split(": ")
        rule[name].append([float(one) for one in values.split(",") if one])
    assert all(np.array_equal(np.ravel(rule[name]), table[name].ravel()) for name in rule)


@pytest.mark.parametrize("name", [name for name in FORMATS.names() if name not in ("csv", "npz", "sensors-csv", "stl")])
def test_formats_that_cannot_hold_them_refuse_and_say_so(tmp_path, name):
    design, _ = rig()
    following = AdaptivePatterns(PatternRule(np.zeros((1, 1)), 1, np.ones(1)), design.patterns * 2, np.ones(2) / 2)
    design = replace(design, layout="chosen", adaptive=following)
    with pytest.raises(ConfigError, match="cannot hold patterns that follow what they see"):
        exported(design, name, tmp_path)
