"""JSON Schemas of what this program reads and prints, made of the models that check it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidardesign.task import Task

DIALECT = "https://json-schema.org/draft/2020-12/schema"
EVALUATE_SCHEMA = Path(__file__).parents[1] / "evaluate" / "evaluate.schema.json"
NULL = {"type": "null"}
NUMBER = {"type": "number"}


def schema_of(kind: str, task: Task | None = None) -> dict[str, Any]:
    """The schema of a kind of document.

    Arguments:
        kind: config, constraints, design or evaluate.
        task: Whose keys the section `task` of a configuration has; any by default.
    """
    if kind == "config":
        return config_schema(task)
    if kind == "constraints":
        return constraints_schema()
    if kind == "design":
        from lidardesign.design.files import SCHEMA_FILE

        return json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))
    return json.loads(EVALUATE_SCHEMA.read_text(encoding="utf-8"))


def config_schema(task: Task | None) -> dict[str, Any]:
    """The schema of `learn --config FILE`: any part of the document that a run keeps as config.yaml."""
    from lidardesign.density.settings import PRESETS, DensitySettings, LearningSettings
    from lidardesign.run.config import MAX_SEED, SCHEMA_VERSION

    named = "" if task is None else f":{task.name}"
    definitions: dict[str, Any] = {}
    own = {"type": "object"} if task is None else _partial(task.Config, "task", definitions)
    return {
        "$schema": DIALECT,
        "$id": f"urn:lidardesign:config:{SCHEMA_VERSION}{named}",
        "title": "Configuration of a run" if task is None else f"Configuration of the task {task.name}",
        "type": "object",
        "additionalProperties": False,
        "properties": {
            "schema_version": {"const": SCHEMA_VERSION},
            "task_name": {"type": "string"} if task is None else {"const": task.name},
            "seed": {"type": "integer", "minimum": 0, "maximum": MAX_SEED},
            "preset": {"enum": [*PRESETS, None]},
            "task": _or_empty(own),
            "space": _or_empty(_space_schema()),
            "density": _or_empty(_partial(DensitySettings, "density", definitions)),
            "learning": _or_empty(_partial(LearningSettings, "learning", definitions)),
        },
        "$defs": definitions,
    }


def _partial(model: Any, section: str, definitions: dict[str, Any]) -> dict[str, Any]:
    """A model's schema without required keys, which --set may give; what it refers to goes to the definitions."""
    schema = model.model_json_schema(ref_template=f"#/$defs/{section}.{{model}}")
    for name, part in schema.pop("$defs", {}).items():
        definitions[f"{section}.{name}"] = part
    schema.pop("required", None)
    return schema


def _or_empty(schema: dict[str, Any]) -> dict[str, Any]:
    """A section that may be there without a key, which YAML reads as null."""
    return {"anyOf": [schema, NULL]}


def _space_schema() -> dict[str, Any]:
    from lidardesign.space import DIMENSIONS

    pair = {"type": "array", "items": NUMBER, "minItems": 2, "maxItems": 2}
    bounds = {"anyOf": [NUMBER, pair], "description": "bounds [low, high], or one number that fixes it"}
    return {
        "type": "object",
        "additionalProperties": False,
        "properties": {
            **dict.fromkeys(DIMENSIONS, bounds),
            "condition": {"type": "array", "items": {"enum": list(DIMENSIONS)}},
            "measure": {"enum": ["solid_angle", "angles"]},
        },
    }


def constraints_schema() -> dict[str, Any]:
    """The schema of `constrain --constraints FILE`."""
    from lidardesign.design.constraints import CATALOG, Constraints

    schema = _with_empty_keys(Constraints.model_json_schema())
    snap = schema["$defs"]["Snap"]
    schema["$defs"]["Snap"] = {"anyOf": [{"const": CATALOG}, snap], "description": snap.pop("description", "")}
    return {"$schema": DIALECT, "$id": "urn:lidardesign:constraints:1", **schema, "title": "Constraints of a design"}


def _with_empty_keys(schema: dict[str, Any]) -> dict[str, Any]:
    """A schema whose keys may all be left empty, as the reader of constraints takes them."""
    for part in (schema, *schema.get("$defs", {}).values()):
        for name, value in part.get("properties", {}).items():
            if name not in part.get("required", ()):
                part["properties"][name] = {"anyOf": [value, NULL]}
    return schema
