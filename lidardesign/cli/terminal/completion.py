"""Values that a shell may offer for arguments and options; files and folders it lists itself."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, get_origin

import typer

if TYPE_CHECKING:
    from pydantic import BaseModel

PACKAGE = Path(__file__).parents[1]


def words(metavar: str) -> Callable[[], list[str]]:
    """The choices that a metavar lists, as draft|standard|fine."""
    return lambda: metavar.split("|")


def tasks() -> list[str]:
    """Installed tasks; none of them is imported."""
    from importlib.metadata import entry_points

    return sorted({entry.name for entry in entry_points(group="lidardesign.tasks")})


def formats() -> list[tuple[str, str]]:
    """Formats of exports with their summaries."""
    from lidardesign.formats.registry import EXPORTERS

    return [(name, exporter.summary) for name, exporter in EXPORTERS.items()]


def parts() -> list[str]:
    """Parts of the catalogue."""
    return sorted(path.stem for path in (PACKAGE / "design" / "catalog" / "parts").glob("*.yaml"))


def detectors() -> list[str]:
    """Detectors that are shipped."""
    return sorted({"ideal", *(path.stem for path in (PACKAGE / "simulate" / "detector" / "presets").glob("*.yaml"))})


def configuration_keys(context: typer.Context) -> list[tuple[str, str]]:
    """Keys of the configuration of the task that is on the command line."""
    from lidardesign.config import DensitySettings, LearningSettings
    from lidardesign.registry import load_task

    # typer leaves arguments in args while the last option waits for its value
    name = context.params.get("task") or context.params.get("name") or context.args[0]
    sections = {"": load_task(name).Config, "density.": DensitySettings, "learning.": LearningSettings}
    return [item for prefix, model in sections.items() for item in _keys(model, prefix)]


def constraint_keys() -> list[tuple[str, str]]:
    """Keys of constraints."""
    from lidardesign.constraints.document import Constraints

    return list(_keys(Constraints, ""))


def _keys(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str]]:
    """The dotted keys of a model, each with =, and what they are."""
    from lidardesign.run.validation import nested_model

    for name, info in model.model_fields.items():
        nested = nested_model(info.annotation)
        if nested is not None and get_origin(info.annotation) is not list:
            yield from _keys(nested, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}=", info.description or ""
