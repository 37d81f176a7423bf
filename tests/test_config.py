"""A configuration is merged in the promised order, and its errors point at where the value came from."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import Field, model_validator

from lidardesign import config as config_module
from lidardesign.config import (
    DensitySettings,
    LearningSettings,
    load_run_config,
    resolve,
    save_run_config,
    with_task_settings,
)
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, DataError
from lidardesign.parts.statements import PartFile
from lidardesign.run.manifest import start_manifest, write_recorded
from lidardesign.run.validation import parse_override, parse_overrides
from lidardesign.run.yaml import dump_yaml
from lidardesign.space import DIMENSIONS, DesignSpace
from lidardesign.task import TASKS, Defaults, Metric, TaskConfig, load_task


class Jitter(TaskConfig):
    angle_rad: float = Field(0.1, ge=0)
    folder: Path | None = None


class ToyConfig(TaskConfig):
    model: Path | None = None
    extra: tuple[Path, ...] = ()
    count: int = Field(3, ge=1)
    label: str = "a"
    jitter: Jitter = Jitter()
    low: float = 0.0
    high: float = 1.0

    @model_validator(mode="after")
    def _ordered(self):
        if self.low > self.high:
            raise ValueError("low is above high")
        return self


class ToyTask:
    name = "toy"
    summary = "for tests"
    api_version = 1
    Config = ToyConfig
    metric = Metric("error", "mm", "lower", 100.0, 0.1)
    defaults = Defaults(density={"sigma_m": 0.01}, learning={"draft": {"steps": 77}})

    def space(self, config):
        return DesignSpace((0, 0, 0, 0, 0, 0.1), (1, 0, 0, 1, 0.5, float(config.count)))

    def scenes(self, config, split, seed):
        return []

    def score(self, scene, returns):
        raise NotImplementedError


TASK = ToyTask()


@pytest.fixture
def write(tmp_path):
    def to_file(text: str) -> Path:
        path = tmp_path / "config.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return to_file


def test_later_layers_win_over_earlier_ones(write):
    assert resolve(TASK).learning.steps == LearningSettings().steps
    assert resolve(TASK, preset="draft").learning.batch == 512
    assert resolve(TASK, preset="draft").learning.steps == 77
    assert resolve(TASK).density.sigma_m == 0.01
    file = write("preset: draft\nseed: 5\nlearning: {steps: 88}\ndensity: {sigma_m: 1e-3}\n")
    resolved = resolve(TASK, config_file=file)
    assert (resolved.preset, resolved.seed, resolved.learning.steps) == ("draft", 5, 88)
    assert resolved.density.sigma_m == 1e-3
    resolved = resolve(TASK, config_file=file, overrides=["learning.steps=99"], seed=6, preset="fine")
    assert (resolved.preset, resolved.seed, resolved.learning.steps) == ("fine", 6, 99)
    assert resolve(TASK, overrides=["learning.steps=2", "learning.steps=2"]).learning.steps == 2


def test_a_bare_or_unknown_first_key_belongs_to_the_task():
    resolved = resolve(TASK, overrides=["count=7", "jitter.angle_rad=0.5", "task.label=b"])
    assert (resolved.task.count, resolved.task.jitter.angle_rad, resolved.task.label) == (7, 0.5, "b")
    assert resolved.space.high[5] == 7.0


TYPED = ("true", "1e3", "007", "2024-01-01", "off", "~x", "False", "1.50")


@pytest.mark.parametrize("text", TYPED)
def test_keys_for_text_and_paths_take_what_was_typed_and_other_keys_what_yaml_reads(write, tmp_path, text):
    here = Path.cwd()
    settings = [f"label={text}", f"model={text}", f"jitter.folder={text}", f"extra=[{text}, b]"]
    task = resolve(TASK, overrides=[*settings, "low=-1e0"]).task
    assert (task.label, task.model, task.jitter.folder) == (text, here / text, here / text)
    assert (task.extra, task.low) == ((here / text, here / "b"), -1.0)
    file = write(f"task: {{label: {text}, model: {text}, jitter: {{folder: {text}}}, extra: [{text}, b]}}")
    task = resolve(TASK, config_file=file).task
    assert (task.label, task.model, task.jitter.folder) == (text, tmp_path / text, tmp_path / text)
    assert task.extra == (tmp_path / text, tmp_path / "b")
    assert resolve(TASK, config_file=file, overrides=["model=null"]).task.model is None
    for wrong in ("count=true", "low='1'"):
        with pytest.raises(ConfigError, match=wrong.partition("=")[0]):
            resolve(TASK, overrides=[wrong])


def test_bounds_replace_those_of_the_task_and_one_number_fixes_a_dimension():
    resolved = resolve(TASK, overrides=["space.x_m=[-1, 2]", "space.z_m=1.5", "space.condition=[x_m]"])
    assert (resolved.space.low[0], resolved.space.high[0]) == (-1, 2)
    assert resolved.space.low[2] == resolved.space.high[2] == 1.5
    assert resolved.space.condition == ("x_m",)
    assert 2 not in resolved.space.free


def test_values_are_read_as_yaml():
    assert parse_override("a=1e-3").value == 1e-3
    assert parse_override("a=null").value is None
    assert parse_override("a=no").value == "no"
    assert parse_override("a=C:/models: one.h5").value == "C:/models: one.h5"
    assert parse_override("a=@file").value == "@file"
    assert parse_override("a='1'").value == "1"
    assert parse_override("a.b=[1, {c: 2}]").value == [1, {"c": 2}]
    assert parse_override("a=x=y").value == "x=y"


def test_paths_become_absolute_from_where_they_were_written(write, tmp_path, monkeypatch):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    file = write("task: {model: data/a.h5, extra: [b.ply], jitter: {folder: c}, label: d}\n")
    resolved = resolve(TASK, config_file=file).task
    assert resolved.model == tmp_path / "data" / "a.h5"
    assert resolved.extra == (tmp_path / "b.ply",)
    assert resolved.jitter.folder == tmp_path / "c"
    assert resolved.label == "d"
    resolved = resolve(TASK, config_file=file, overrides=["model=../m.h5", "jitter.folder=f"]).task
    assert resolved.model == tmp_path / "m.h5"
    assert resolved.jitter.folder == elsewhere / "f"
    assert resolved.extra == (tmp_path / "b.ply",)
    assert resolve(TASK, overrides=["model=null"]).task.model is None
    assert resolve(TASK, overrides=["model=~/m.h5"]).task.model == Path.home() / "m.h5"
    assert resolve(TASK, overrides=["model=~nobody-at-all/m.h5"]).task.model == elsewhere / "~nobody-at-all" / "m.h5"


BAD_FILES = {
    "unknown section": ("desnity: {sigma_m: 1}", "1:1", "did you mean 'density'"),
    "unknown key": ("density:\n  sigma: 0.1\n", "2:3", "did you mean 'sigma_m'"),
    "unknown task key": ("task:\n  cuont: 1\n", "2:3", "did you mean 'count'"),
    "nested unknown key": ("task:\n  jitter:\n    angle: 1\n", "3:5", "angle_rad"),
    "negative sigma": ("density:\n  sigma_m: -0.1\n", "2:12", "greater than or equal to 0.000000001"),
    "wrong type": ("learning:\n  steps: many\n", "2:10", "valid integer"),
    "wrong word": ("density: {visibility: perhaps}\n", "1:23", "raycast"),
    "boolean for a word": ("density: {visibility: true}\n", "1:23", "raycast"),
    "reversed bounds": ("space:\n  x_m: [2, 1]\n", "2:8", "above the upper bound"),
    "bounds of three": ("space:\n  x_m: [0, 1, 2]\n", "2:8", "at most 2 items"),
    "too steep": ("space:\n  elevation_rad: [-2, 0]\n", "2:18", "leaves the sphere"),
    "unknown dimension": ("space:\n  condition: [w_m]\n", "2:15", "x_m"),
    "a dimension twice": ("space:\n  condition: [x_m, x_m]\n", "2:14", "given twice"),
    "section without keys": ("density: 3\n", "1:1", "keys and values"),
    "other task": ("task_name: face\n", "1:12", "toy"),
    "newer schema": ("schema_version: 2\n", "1:17", "schema version 2"),
    "preset": ("preset: quick\n", "1:9", "draft, standard, fine"),
    "seed": ("seed: -1\n", "1:7", "whole number"),
    "rule of the task": ("task:\n  low: 2\n", "", "low is above high"),
    "one range": ("space:\n  range_m: 0.5\n", "2:12", "found one range, 0.5"),
    "nothing behind a key": ("density:\n  sigma_m:\n  margin_m: 1\n", "2:11", "density.sigma_m has no value"),
    "nothing in a list": ("space:\n  x_m:\n  - 0\n  -\n", "4:4", "space.x_m.1 has no value"),
    "duplicate": ("density:\n  sigma_m: 1\n  sigma_m: 2\n", "3:3", "given before"),
    "list": ("- a\n", "1:1", "keys and values"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_errors_in_a_file_point_at_line_and_column(write, case):
    text, position, words = BAD_FILES[case]
    file = write(text)
    with pytest.raises(ConfigError) as caught:
        resolve(TASK, config_file=file)
    assert caught.value.where.startswith(f"{file}:{position}"), caught.value.where
    assert words in str(caught.value)
    assert caught.value.exit_code == 2


BAD_OVERRIDES = {
    "density.sigma_m=-1": "greater than or equal to 0.000000001",
    "density.sigma=1": "did you mean 'sigma_m'",
    "density.steps=1": "did you mean 'learning.steps'",
    "density.count=1": "did you mean 'task.count'",
    "sigma=1": "did you mean 'density.sigma_m'",
    "densty.sigma_m=1": "did you mean 'density'",
    "density.sigma_m=": "sigma_m has no value",
    "density.margin_m=": "margin_m has no value",
    "label= ": "label has no value",
    "space=": "space has no value",
    "density=3": "unknown key 'task.density'",
    "count=0": "greater than or equal to 1",
    "count=1.5": "valid integer",
    "cuont=1": "did you mean 'count'",
    "space.x_m=[2,1]": "above the upper bound",
    "space.x_m=[a,1]": "valid number",
    "space.x_m=[0,1": "not YAML",
    "space.x_m=[0,.inf]": "finite",
    "space.range_m=[-1,1]": "negative",
    "space.x_m.0=[1]": "x_m",
    "learning.rate.x=1": "valid number",
    "label.x=1": "label",
    "learning.steps=true": "found True",
    'density.sigma_m="0.1"': "without quotes",
    "count=false": "found False",
    "space.x_m=[true,2]": "found True",
    'space.x_m=["0",2]': "found '0'",
    "extra.0.x=1": "extra",
    "nothing": "KEY=VALUE",
    "=1": "KEY=VALUE",
    "a..b=1": "KEY=VALUE",
}


@pytest.mark.parametrize("override", BAD_OVERRIDES)
def test_errors_in_an_override_show_it(override):
    with pytest.raises(ConfigError) as caught:
        resolve(TASK, overrides=[override])
    assert caught.value.where == f"--set {override}" or caught.value.where.startswith(f"--set {override}:")
    assert BAD_OVERRIDES[override] in str(caught.value)


@pytest.mark.parametrize(
    ("section", "key"),
    [
        *(("density", key) for key in DensitySettings.model_fields),
        *(("learning", key) for key in LearningSettings.model_fields),
        *(("space", key) for key in DIMENSIONS),
    ],
)
def test_a_key_without_its_section_is_named_with_it(write, section, key):
    hint = f"did you mean '{section}.{key}'?"
    with pytest.raises(ConfigError) as caught:
        resolve(TASK, overrides=[f"{key}=1"])
    assert caught.value.hint == hint
    with pytest.raises(ConfigError) as caught:
        resolve(TASK, config_file=write(f"{key}: 1\n"))
    assert caught.value.hint == hint


def test_an_override_of_a_file_takes_the_blame_for_its_value(write):
    file = write("density: {sigma_m: 0.1}\n")
    with pytest.raises(ConfigError, match=r"^--set density\.sigma_m=-1"):
        resolve(TASK, config_file=file, overrides=["density.sigma_m=-1"])


def test_a_list_item_is_set_by_its_index(write):
    file = write("task: {extra: [a.ply, b.ply]}\n")
    resolved = resolve(TASK, config_file=file, overrides=["extra.1=/c.ply"])
    assert resolved.task.extra[1] == Path("/c.ply")
    with pytest.raises(ConfigError, match="0 to 1"):
        resolve(TASK, config_file=file, overrides=["extra.2=/c.ply"])


def test_what_was_saved_is_loaded_back(tmp_path, monkeypatch):
    monkeypatch.setattr(config_module, "load_task", lambda name: {"toy": TASK}[name])
    start_manifest(tmp_path, command=[], seed=0)
    overrides = [
        "space.x_m=[-1, 2]",
        "density.sigma_m=1e-5",
        "model=m.h5",
        "label='1e-3'",
        "jitter.angle_rad=0.3",
    ]
    saved = resolve(TASK, preset="fine", overrides=overrides, seed=11)
    save_run_config(saved, tmp_path)
    task, loaded = load_run_config(tmp_path)
    assert task is TASK
    assert loaded == saved
    assert DensitySettings().model_dump().keys() <= loaded.as_document()["density"].keys()
    assert [name for name in DIMENSIONS if name not in loaded.as_document()["space"]] == []


def test_settings_that_only_earlier_versions_had_are_left_out_of_their_runs_and_refused_elsewhere(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(config_module, "load_task", lambda name: {"toy": TASK}[name])
    start_manifest(tmp_path, command=[], seed=0)
    document = resolve(TASK, overrides=["learning.steps=700"]).as_document()
    for key in ("misplaced", "pathwise"):
        del document["learning"][key]
    document["learning"] |= {"anneal": 0.7, "balance": 0.5}
    write_recorded(tmp_path, "config.yaml", dump_yaml(document).encode())
    loaded = load_run_config(tmp_path)[1]
    assert loaded == resolve(TASK, config_file=tmp_path / "config.yaml")
    assert (loaded.learning.steps, loaded.learning.pathwise) == (700, LearningSettings().pathwise)
    other = (tmp_path / "config.yaml").rename(tmp_path / "mine.yaml")
    with pytest.raises(ConfigError, match=r"mine\.yaml:\d+:3: unknown key 'learning\.(anneal|balance)'"):
        resolve(TASK, config_file=other)


def test_a_saved_configuration_that_was_edited_is_noticed(tmp_path):
    start_manifest(tmp_path, command=[], seed=0)
    save_run_config(resolve(TASK), tmp_path)
    path = tmp_path / "config.yaml"
    path.write_text(path.read_text().replace("0.01", "0.02"))
    with pytest.raises(DataError, match="changed"):
        load_run_config(tmp_path)


def test_a_run_is_judged_by_other_values_of_its_task_and_keeps_the_rest():
    config = resolve(TASK, overrides=["label=b", "density.sigma_m=0.02"])
    judged = with_task_settings(TASK, config, ["jitter.angle_rad=0.5"])
    assert judged.task == config.task.model_copy(update={"jitter": Jitter(angle_rad=0.5)})
    assert (judged.density, judged.learning, judged.space) == (config.density, config.learning, config.space)
    assert with_task_settings(TASK, config, []) == config


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("count=4", "design space"),
        ("density.sigma_m=0.03", "what was learned cannot be changed"),
        ("sigma_m=0.03", "what was learned cannot be changed"),
        ("space.x_m=0", "what was learned cannot be changed"),
        ("lable=b", "unknown key"),
        ("jitter.angle_rad=-1", "jitter.angle_rad"),
    ],
)
def test_what_was_learned_stays_when_a_run_is_judged(override, message):
    with pytest.raises(ConfigError, match=message) as caught:
        with_task_settings(TASK, resolve(TASK), [override])
    assert override in str(caught.value.where)


@pytest.mark.parametrize(
    "texts", [("a=1", "a=2"), ("task.a=1", "a=2"), ("a.b=1", "a={b: 2}"), ("a={b: 1}", "b=1", "a.b.c=2")]
)
def test_a_key_that_is_set_twice_is_refused(texts):
    with pytest.raises(ConfigError, match="is already set by --set") as caught:
        parse_overrides(texts)
    assert caught.value.where == f"--set {texts[-1]}"
    assert len(parse_overrides(["d.b=1", "d.c=1", "db=2", *texts[:1], *texts[:1]])) == 5


@pytest.mark.parametrize("text", [".".join("a" * count) + "=1" for count in (33, 500, 5000)])
def test_a_key_of_many_parts_is_refused(text):
    with pytest.raises(ConfigError, match=r"(?s)has \d+ parts.*at most 32"):
        parse_override(text)


def unlimited(schema, path=""):
    """The numbers of a schema that have no largest or no smallest value."""
    if isinstance(schema, dict):
        limits = {name.removeprefix("exclusive").lower() for name in schema} & {"minimum", "maximum"}
        if schema.get("type") in ("number", "integer") and "const" not in schema and len(limits) < 2:
            yield path
        for name, part in schema.items():
            yield from unlimited(part, f"{path}.{name}")
    elif isinstance(schema, list):
        for part in schema:
            yield from unlimited(part, path)


MODELS = [DensitySettings, LearningSettings, Constraints, PartFile]
MODELS += [load_task(item.name).Config for item in TASKS.listings() if item.distribution.startswith("lidardesign ")]


@pytest.mark.parametrize("model", MODELS)
def test_every_number_that_a_user_sets_has_limits(model):
    assert not list(unlimited(model.model_json_schema()))
