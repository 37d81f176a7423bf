"""Names that options and arguments can have: of tasks, formats, parts, effects, and keys with their values."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from lidardesign.cli.completing import Line

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pydantic import BaseModel

    from lidardesign.task import Task

    Items = Sequence[tuple[str, str]]

GROUP = "lidardesign.tasks"
PACKAGE = Path(__file__).parents[1]
# `evaluate --baseline` takes these, and says so where it is given another; scores of them are not needed to list them.
BASELINES = {
    "uniform": "even over the whole design space",
    "random": "random over the whole design space",
    "bounding": "one even grid cropped to the training returns",
    "occupancy": "rays towards cells that targets occupy",
    "no-visibility": "the first design without its occlusion term",
    "catalog:": "a real part where it sees most",
    "cma": "direct optimisation on training scenes",
}
EFFECT_WORDS = ("auto", "all", "none", "audit")
CONFIGURATION = "config.yaml"
MEASURES = ("solid_angle", "angles")


def tasks(line: Line, current: str) -> Items:
    """Names of installed tasks; none of them is imported."""
    from importlib.metadata import entry_points

    return [(name, "a task") for name in sorted({entry.name for entry in entry_points(group=GROUP)})]


def formats(line: Line, current: str) -> Items:
    """Names of export formats."""
    from lidardesign.export.registry import EXPORTERS

    return [(name, exporter.summary) for name, exporter in EXPORTERS.items()]


def parts(line: Line, current: str) -> Items:
    """Names of the shipped parts."""
    return [(path.stem, "a part") for path in sorted((PACKAGE / "design" / "catalog" / "parts").glob("*.yaml"))]


def detectors(line: Line, current: str) -> Items:
    """Names of the shipped detectors."""
    found = sorted((PACKAGE / "simulate" / "detector" / "presets").glob("*.yaml"))
    return [(name, "a detector") for name in dict.fromkeys(("ideal", *(path.stem for path in found)))]


def baselines(line: Line, current: str) -> Items:
    """Names of baselines; behind `catalog:` parts."""
    if current.startswith("catalog:"):
        return [(f"catalog:{name}", words) for name, words in parts(line, current)]
    return list(BASELINES.items())


def effects(line: Line, current: str) -> Items:
    """Words for effects, or names between commas."""
    from lidardesign.simulate.physics import EFFECTS

    before, comma, _ = current.rpartition(",")
    taken = before.split(",")
    names = [name for name in EFFECTS if name not in taken]
    return [(f"{before}{comma}{name}", "an effect") for name in ([] if comma else EFFECT_WORDS)] + [
        (f"{before}{comma}{name}", "an effect") for name in names
    ]


def conditions(line: Line, current: str) -> Items:
    """Conditions of the run's density, as `x_m=`."""
    space = _run_document(line).get("space")
    named = space.get("condition") if isinstance(space, dict) else None
    return [(f"{name}=", "a condition") for name in named or () if isinstance(name, str)]


def weights(line: Line, current: str) -> Items:
    """Keys of the task that only say what counts more in the density."""
    task = _task_of_run(line)
    weighing = set(getattr(task, "weighing_keys", ())) if task is not None else set()
    return [] if task is None else [item for item in keyed(task.Config, "", current) if _key(item[0]) in weighing]


def configuration_keys(line: Line, current: str) -> Items:
    """Keys of a task's configuration, or behind `=` the values of one that has few.

    Of a run only those of the task itself: the density was learned.
    """
    from lidardesign.config import DensitySettings, LearningSettings
    from lidardesign.registry import load_task
    from lidardesign.space import DIMENSIONS

    named = line.given.get("TASK") or line.given.get("--task")
    if not named:
        task = _task_of_run(line)
        return [] if task is None else list(keyed(task.Config, "", current))
    items = list(keyed(load_task(named[0]).Config, "", current))
    items += keyed(DensitySettings, "density.", current)
    items += keyed(LearningSettings, "learning.", current)
    items += [(f"space.{name}=", "bounds, as [0,1]") for name in (*DIMENSIONS, "condition")]
    return items + [(f"space.measure={value}", "") for value in MEASURES if current.startswith("space.measure=")]


def constraint_keys(line: Line, current: str) -> Items:
    """Keys of constraints, as `gate.width_m.max=`."""
    from lidardesign.design.constraints.document import CATALOG, Constraints

    items = [item for item in keyed(Constraints, "", current) if not item[0].startswith("each")]
    return [(f"snap={CATALOG}", "every sensor becomes a real part"), *items]


def keyed(model: type[BaseModel], prefix: str, current: str) -> Iterator[tuple[str, str]]:
    """The dotted keys of a model that hold values, each with =; the values of one that is typed already.

    Arguments:
        model: The model.
        prefix: What stands before its keys.
        current: What is typed.
    """
    from lidardesign.run.validation import nested_model

    for name, info in model.model_fields.items():
        nested = nested_model(info.annotation)
        if nested is not None and get_origin(info.annotation) is not list:
            yield from keyed(nested, f"{prefix}{name}.", current)
            continue
        key = f"{prefix}{name}="
        values = _few_values(info.annotation) if current.startswith(key) else ()
        yield from ((f"{key}{value}", "") for value in values) if values else [(key, info.description or "")]


def _few_values(annotation: Any) -> tuple[str, ...]:
    """The values of a key that takes one of a few words."""
    if get_origin(annotation) is Literal:
        return tuple(str(value) for value in get_args(annotation))
    if annotation is bool:
        return ("true", "false")
    return tuple(value for part in get_args(annotation) for value in _few_values(part))


def _key(item: str) -> str:
    return item.partition("=")[0]


def _task_of_run(line: Line) -> Task | None:
    """The task of the run that a command line names."""
    from lidardesign.registry import load_task

    name = _run_document(line).get("task_name")
    return load_task(name) if isinstance(name, str) else None


def _run_document(line: Line) -> Mapping[str, Any]:
    """The configuration of the run that a command line names, or that one of its designs lies in; else nothing."""
    from lidardesign.errors import ConfigError
    from lidardesign.run.yaml import load_yaml

    for metavar in ("RUN", "RUN|DESIGN", "DESIGN"):
        for word in line.given.get(metavar, ()):
            path = Path(os.path.expanduser(word))
            for folder in (path, path.parent.parent):
                if (folder / CONFIGURATION).is_file():
                    try:
                        return load_yaml(folder / CONFIGURATION).mapping
                    except ConfigError:
                        return {}
    return {}
