"""`config init` writes what changes nothing until it is edited; `config schema` agrees with what the program reads."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidardesign.api.config_reference import config_template, config_text, default_document, schema_of
from lidardesign.config import PRESETS, DensitySettings, LearningSettings, resolve
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.task import TASKS, Metric, TaskConfig, load_task

TASKS = [item.name for item in TASKS.listings() if item.error is None and item.distribution.startswith("lidardesign ")]
# They need a folder or a model, so that no configuration follows from the defaults alone.
WITHOUT_DEFAULTS = {"meshes": "folder", "mujoco": "model"}


def written(task, tmp_path, preset=None):
    path = tmp_path / "config.yaml"
    path.write_text(config_template(task, preset=preset)[1])
    return path


def uncommented(text):
    """A file to begin with, with every default set."""
    whole, count = re.subn(r"(?m)^( *)#(?=\S)", r"\1", text)
    assert count
    return whole


@pytest.mark.parametrize("name", TASKS)
def test_a_file_to_begin_with_changes_nothing(name, tmp_path):
    task = load_task(name)
    path = written(task, tmp_path)
    if name in WITHOUT_DEFAULTS:
        with pytest.raises(ConfigError, match=WITHOUT_DEFAULTS[name]):
            resolve(task, config_file=path)
        return
    for preset in PRESETS:
        assert resolve(task, preset=preset, config_file=path) == resolve(task, preset=preset)


@pytest.mark.parametrize("name", [name for name in TASKS if name not in WITHOUT_DEFAULTS])
@pytest.mark.parametrize("preset", PRESETS)
def test_all_of_its_defaults_are_the_ones_that_hold(name, preset, tmp_path):
    task = load_task(name)
    path = written(task, tmp_path, preset)
    path.write_text(uncommented(path.read_text()))
    assert resolve(task, config_file=path).as_document() == resolve(task, preset=preset).as_document()


@pytest.mark.parametrize("name", TASKS)
def test_every_key_is_there_with_what_it_is(name, tmp_path):
    task = load_task(name)
    text = written(task, tmp_path).read_text()
    for model in (task.Config, DensitySettings, LearningSettings):
        for key, info in model.model_fields.items():
            assert f"\n  #{key}: " in text
            assert " ".join((info.description or "").split())[:40] in text
    assert max(map(len, text.splitlines())) <= 120


def test_what_is_chosen_is_set_and_all_else_is_not(lidardesign, tmp_path):
    chosen = ("--preset", "draft", "--set", "density.sigma_m=0.01", "--set", "variation=2", "--seed", 7)
    result = lidardesign("config", "init", "flatland", *chosen)
    path = tmp_path / "flat.yaml"
    path.write_text(result.out)
    assert parse_yaml(result.out, where="text", empty_sections=True).value == {
        "schema_version": 1,
        "task_name": "flatland",
        "seed": 7,
        "preset": "draft",
        "task": {"variation": 2.0},
        "space": None,
        "density": {"sigma_m": 0.01},
        "learning": None,
    }
    assert resolve(load_task("flatland"), config_file=path).density.sigma_m == 0.01


@given(st.text(), st.text(), st.text())
def test_no_word_of_a_task_leaves_its_comment(summary, description, unit):
    config = type(
        "Config",
        (TaskConfig,),
        {"__annotations__": {"width": str}, "width": description},
    )
    config.model_fields["width"].description = description
    task = SimpleNamespace(
        name="odd",
        summary=summary,
        Config=config,
        metric=Metric("name", unit, "lower", 1.0, 0.1),
        defaults=SimpleNamespace(density={}, learning={}),
    )
    text = config_text(task, default_document(task, "draft"), "draft")
    assert parse_yaml(text, where="text", empty_sections=True).value == {
        "schema_version": 1, "task_name": "odd", "task": None, "space": None, "density": None, "learning": None
    }  # fmt: skip


def accepts(schema, value):
    return jsonschema.Draft202012Validator(schema).is_valid(value)


@pytest.mark.parametrize("kind", ["config", "constraints", "design", "evaluate"])
def test_schemas_are_schemas_and_are_printed_as_such(lidardesign, kind):
    printed = json.loads(lidardesign("config", "schema", kind).out)
    jsonschema.Draft202012Validator.check_schema(printed)
    assert printed["$id"].startswith(f"urn:lidardesign:{kind}:")
    assert lidardesign("config", "schema", kind, "--json").json["schema"] == printed


@pytest.mark.parametrize("name", TASKS)
def test_a_configuration_that_is_resolved_is_valid(name, tmp_path):
    task = load_task(name)
    document = parse_yaml(uncommented(written(task, tmp_path).read_text()), where="text", empty_sections=True).value
    document["space"] = None if name in WITHOUT_DEFAULTS else document["space"]
    assert accepts(schema_of("config", task), document)
    assert accepts(schema_of("config"), document)


CONFIGURATIONS = [
    {},
    {"density": None},
    {"density": {"sigma_m": 0.01}},
    {"density": {"sigma_m": -1}},
    {"density": {"sigma": 0.01}},
    {"density": {"visibility": "maybe"}},
    {"density": {"margin_m": None}},
    {"learning": {"steps": 0}},
    {"learning": {"steps": 1.5}},
    {"learning": {"dtype": "float16"}},
    {"space": {"x_m": [0, 1]}},
    {"space": {"x_m": 0.5}},
    {"space": {"x_m": [0, 1, 2]}},
    {"space": {"w_m": 0.5}},
    {"task": {"variation": 1}},
    {"task": {"variation": 3}},
    {"task": {"scene": "moon"}},
    {"task": {"scene": "discs"}},
    {"task_name": "face"},
    {"preset": "draft"},
    {"preset": "quick"},
    {"preset": None},
    {"seed": -1},
    {"seed": 1},
    {"more": 1},
    {"schema_version": 2},
]


@pytest.mark.parametrize("values", CONFIGURATIONS, ids=str)
def test_the_schema_of_a_configuration_takes_what_the_program_takes(values, tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(dump_yaml(values))
    task = load_task("flatland")
    try:
        resolve(task, config_file=path)
        taken = True
    except ConfigError:
        taken = False
    assert accepts(schema_of("config", task), values) == taken


CONSTRAINTS = [
    {},
    {"gate": {"width_m": {"max": 0.1}}},
    {"gate": {"width_m": {"max": 0}}},
    {"gate": {"width_m": {"most": 1}}},
    {"gate": None},
    {"gate": {"width_m": None}},
    {"gate": 3},
    {"sensors": {"count": 4}},
    {"sensors": {"count": 0}},
    {"sensors": {"count": "4"}},
    {"parts": {"names": "catalog", "count": 2}},
    {"parts": {"names": "shop"}},
    {"parts": {"names": ["vl53l5cx"], "each": {"vl53l5cx": {"max": 1}}, "power_w": 2.5}},
    {"parts": {"names": []}},
    {"parts": {"count": 2}},
    {"each": [{"gate": {"width_m": {"max": 0.05}}}]},
    {"each": [{"sensors": {"count": 1}}]},
    {"origin": {"fixed_m": [0, 0, 1]}},
    {"origin": {"fixed_m": [0, 0]}},
    {"origin": {"exclude": [{"low_m": [0, 0, 0], "high_m": [1, 1, 1]}]}},
    {"origin": {"exclude": [{"low_m": [0, 0, 0]}]}},
    {"budget": {"rays": 576, "bandwidth_mbps": 2.0}},
    {"budget": {"rays": 0}},
    {"boresight": {"elevation_deg": {"max": 91}}},
    {"field_of_view": {"horizontal_deg": {"max": 20}}},
]


@pytest.mark.parametrize("values", CONSTRAINTS, ids=str)
def test_the_schema_of_constraints_takes_what_the_program_takes(values):
    try:
        Constraints.from_mapping(values)
        taken = True
    except ConfigError:
        taken = False
    assert accepts(schema_of("constraints"), values) == taken


def test_what_evaluate_prints_is_valid_and_complete(lidardesign, flat):
    """With nearly all that adds to it."""
    assert lidardesign("fit", flat, "--layout", "even", "--sensors", 1).code == 0
    search = ("--baseline", "cma", "--cma-seconds", 0.1, "--set", "test=2")
    audited = ("--effects", "audit", "--mount-error", "5mm")
    evaluation = lidardesign("evaluate", flat, "--rays", 9, *search, *audited, "--json", "--quiet").json
    schema = schema_of("evaluate")
    jsonschema.Draft202012Validator(schema).validate(evaluation)
    for name in ("rows", "paired", "equal_bandwidth", "effects", "cma", "error_estimates", "audit", "mounting"):
        assert evaluation[name]
    assert set(evaluation) == set(schema["properties"])
    for name in evaluation:
        rest = {key: value for key, value in evaluation.items() if key != name}
        assert accepts(schema, rest) == (name not in schema["required"])
    assert not accepts(schema, {**evaluation, "more": 1})
    assert not accepts(schema, {**evaluation, "rows": [{**evaluation["rows"][0], "value": "good"}]})


def test_the_rungs_of_accuracy_are_those_of_the_schema():
    from lidardesign.evaluation.sweep import Measurement, Sweep

    measurements = [
        Measurement("4", 0.1, 0.01, 2.0, values={"gap_mm": 1.0}),
        Measurement("8", 0.0, 0.0, 4.0, 5, True, True),
    ]
    sweep = Sweep("knob", "gap", "mm", "the finest", 0.5, "it is small", "work", measurements)
    schema = schema_of("evaluate")
    one = {"$ref": "#/$defs/rung", "$defs": schema["$defs"]}
    for row in sweep.as_rows():
        jsonschema.Draft202012Validator(one).validate(row)
