"""Options that several subcommands share, and their values for shell completion (files are completed by the shell)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_origin

import typer
from typer.core import TyperCommand

from lidardesign.errors import UNSET_HINT, ConfigError

if TYPE_CHECKING:
    from pydantic import BaseModel

PACKAGE = Path(__file__).parents[2]


def words(metavar: str) -> Callable[[], list[str]]:
    """The choices that a metavar lists, as draft|standard|fine."""
    return lambda: metavar.split("|")


def tasks() -> list[str]:
    """Installed tasks; none of them is imported."""
    return _plugins("lidardesign.tasks")


def formats() -> list[str]:
    """Installed formats of exports; none of them is imported."""
    return _plugins("lidardesign.formats")


def _plugins(group: str) -> list[str]:
    from importlib.metadata import entry_points

    return sorted({entry.name for entry in entry_points(group=group)})


def parts() -> list[str]:
    """Parts of the catalogue."""
    return sorted(path.stem for path in (PACKAGE / "parts" / "files").glob("*.yaml"))


def detectors() -> list[str]:
    """Detectors that are shipped."""
    return sorted({"ideal", *(path.stem for path in (PACKAGE / "simulate" / "detector" / "presets").glob("*.yaml"))})


def configuration_keys(context: typer.Context) -> list[tuple[str, str]]:
    """Keys of the configuration of the task that is on the command line."""
    from lidardesign.config import DensitySettings, LearningSettings
    from lidardesign.task import load_task

    # typer leaves arguments in args while the last option waits for its value
    name = context.params.get("task") or context.params.get("name") or context.args[0]
    sections = {"": load_task(name).Config, "density.": DensitySettings, "learning.": LearningSettings}
    return [item for prefix, model in sections.items() for item in _keys(model, prefix)]


def constraint_keys() -> list[tuple[str, str]]:
    """Keys of constraints."""
    from lidardesign.constraints.document import Constraints

    return list(_keys(Constraints, ""))


def _keys(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str]]:
    """The dotted keys of a model, each with =, and their descriptions."""
    from lidardesign.run.validation import nested_model

    for name, info in model.model_fields.items():
        nested = nested_model(info.annotation)
        if nested is not None and get_origin(info.annotation) is not list:
            yield from _keys(nested, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}=", info.description or ""


Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout, for errors too.")]
Seed = Annotated[
    int | None,
    typer.Option("--seed", metavar="N", help="Seed of all random numbers.", show_default="the run's, or 0"),
]
Quiet = Annotated[
    bool,
    typer.Option("--quiet", "-q", help="Print no notes or progress; for a result in a file, only its path."),
]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Print everything: all tables and notes.")]
Name = Annotated[str, typer.Option("--name", metavar="NAME", help="Name of the design: RUN/designs/NAME.yaml.")]
Layout = Annotated[
    str | None,
    typer.Option(
        "--layout",
        metavar="chosen|even|spinning",
        help="Rays chosen on training scenes, even in the field of view, or on chosen rings.",
        show_default="the design's, else chosen; even where rays cannot be chosen",
        autocompletion=words("chosen|even|spinning"),
    ),
]
At = Annotated[
    list[str] | None,
    typer.Option(
        "--at",
        metavar="NAME=VALUE",
        help="Value of a condition, such as the robot's position x_m=0.37; exact, no window. Repeatable.",
        show_default=False,
    ),
]
RayCount = Annotated[
    int | None,
    typer.Option(
        "--rays",
        metavar="N",
        min=1,
        max=1_000_000,
        help="Rays per frame, over all sensors.",
        show_default="the task's numbers; even rays leave it open",
    ),
]
Channels = Annotated[
    int | None,
    typer.Option(
        "--channels",
        metavar="N",
        min=1,
        help="Channels (chosen rings) per sensor in the layout spinning.",
        show_default="the design's, else 16",
    ),
]
Level = Annotated[
    float | None,
    typer.Option(
        "--level",
        metavar="SHARE",
        help="Share of rays and returns that fields of view and gates contain, such as 0.99.",
        show_default="the design's, else 0.999 for chosen rays and the task's for others",
    ),
]
Gates = Annotated[
    str | None,
    typer.Option(
        "--gates",
        metavar="sensor|ray",
        help="One gate per sensor, or one per ray.",
        show_default="the design's, else sensor; ray where rays are chosen along a condition",
        autocompletion=words("sensor|ray"),
    ),
]
Sensors = Annotated[
    str | None,
    typer.Option(
        "--sensors",
        metavar="N|N-M|best",
        help="Number of sensors; best: by the task's score on training scenes; N-M: of parts, a table and the best.",
        show_default="the design's, else best",
    ),
]
Parts = Annotated[
    str | None,
    typer.Option(
        "--parts",
        metavar="NAME,NAME|catalog",
        help="Make the design of real parts (catalog names, NAME:MODE, part files), chosen with their poses; "
        "--sensors says how many.",
        show_default=False,
    ),
]
Modules = Annotated[
    int | None,
    typer.Option("--modules", metavar="N", min=1, help="This many modules with --fov and --zones.", show_default=False),
]
ModuleField = Annotated[
    str | None,
    typer.Option("--fov", metavar="WxH", help="Module field of view in degrees, such as 45x45.", show_default=False),
]
ModuleZones = Annotated[
    str | None, typer.Option("--zones", metavar="CxR", help="Module zones, such as 8x8.", show_default=False)
]
Detector = Annotated[
    str,
    typer.Option(
        "--detector",
        metavar="NAME|FILE",
        help="The detector: ideal, single-photon, consumer-8x8, or a YAML file.",
        autocompletion=detectors,
    ),
]
Judge = Annotated[
    str | None,
    typer.Option(
        "--detector",
        metavar="NAME|FILE",
        help="Judge sets of parts and numbers of sensors under a detector (see `evaluate`).",
        show_default="ideal",
        autocompletion=detectors,
    ),
]
SceneSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="A key of the task: choose in scenes other than the learned ones; repeatable.",
    ),
]
Weights = Annotated[
    list[str] | None,
    typer.Option(
        "--weight",
        metavar="KEY=VALUE",
        help="Weight the learned density for another setting of the task, such as importance; nothing is learned "
        "again. Repeatable.",
        show_default=False,
    ),
]
Workers = Annotated[
    str,
    typer.Option(
        "--workers",
        metavar="N|tcp://HOST:PORT",
        help="Look at scenes with this many processes on this machine, or with the workers of a dask scheduler (extra: "
        "cluster). The results are the same.",
    ),
]
Certify = Annotated[
    bool,
    typer.Option(
        "--certify", help="Bound what any other choice could gain at every number of rays, not just the middle one."
    ),
]
Survive = Annotated[
    int | None,
    typer.Option("--survive", metavar="0|1", help="1: allow for the loss of any one sensor.", show_default="0"),
]
Losses = Annotated[bool, typer.Option("--losses", help="Also score designs with each sensor lost in turn.")]
Goal = Annotated[
    float | None,
    typer.Option(
        "--goal", metavar="SCORE", help="Score to keep with as little as possible (see --least).", show_default=False
    ),
]
LEAST = "bandwidth|rays|sensors|parts"
Least = Annotated[
    str | None,
    typer.Option(
        "--least", metavar=LEAST, help="What --goal minimises; by default bandwidth.", autocompletion=words(LEAST)
    ),
]
Adaptive = Annotated[
    int | None,
    typer.Option("--adaptive", metavar="N", help="At most N patterns; returns pick the next one.", show_default="1"),
]
Preset = Annotated[
    str | None,
    typer.Option(
        "--preset",
        metavar="draft|standard|fine",
        help="Effort: about ten seconds, half a minute, or minutes.",
        show_default="standard",
        autocompletion=words("draft|standard|fine"),
    ),
]
Like = Annotated[
    Path | None,
    typer.Option(
        "--like",
        metavar="RIG",
        readable=False,
        help="Use no more than an existing rig (a design, rays as CSV or NPZ, a MuJoCo model, an SDF file): as many "
        "sensors and rays, its places, fields of view and gates no wider. Your own constraints take precedence.",
        show_default=False,
    ),
]
SpaceOf = Annotated[
    Path | None,
    typer.Option(
        "--in",
        metavar="RUN",
        help="Take the task, its scenes and the design space of this run, for designs of any origin.",
        show_default="the run that designs came from",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Set one value, such as density.sigma_m=0.002 (`tasks show TASK` lists keys); repeatable.",
        show_default=False,
        autocompletion=configuration_keys,
    ),
]
ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="YAML file with any of the sections task, space, density, learning.",
        show_default=False,
    ),
]


def parse_at(texts: list[str] | None) -> dict[str, float]:
    """The values of `--at`, as {"x_m": 0.37}; the design space checks their names.

    Raises:
        ConfigError: One is not NAME=VALUE with a finite number, or a name is given twice.
    """
    from lidardesign.run.yaml import plain_number

    values: dict[str, float] = {}
    for text in texts or []:
        name, equals, value = (part.strip() for part in text.partition("="))
        try:
            number = plain_number(value)
        except ValueError:
            number = math.nan
        if not (name and equals and math.isfinite(number)):
            raise ConfigError(f"{text!r}", where="--at", allowed="NAME=VALUE with a finite number, such as x_m=0.37")
        if name in values:
            raise ConfigError(f"{name} is given twice: {values[name]:g} and {number:g}", where="--at")
        values[name] = number
    return values


def part_names(
    parts: str | None, modules: int | None, fov: str | None, zones: str | None, sensors: str | None
) -> tuple[list[str] | str | None, int | str | None]:
    """The parts that are named, `catalog` for all that are shipped, or modules; and the number of sensors.

    Raises:
        ConfigError: A name is empty, or a module lacks something.
    """
    if (modules, fov, zones) == (None, None, None):
        names = [] if parts is None else [name.strip() for name in parts.split(",")]
        if not all(names):
            raise ConfigError(f"{parts!r} has an empty part name", where="--parts", allowed="NAME,NAME or catalog")
        count = int(sensors) if sensors is not None and re.fullmatch("[0-9]{1,9}", sensors) else sensors
        return (parts if parts in (None, "catalog") else names), count
    if None in (modules, fov, zones) or (parts, sensors) != (None, None):
        allowed = "--modules N --fov WxH --zones CxR, without --sensors and --parts"
        raise ConfigError("the description of the modules is incomplete", where="--modules", allowed=allowed)
    return [f"module-{fov}-{zones}"], modules


class StrictCommand(TyperCommand):
    """A command that refuses option values that are likely typing errors."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the command line; values that are empty or -, and numbers such as `1_0`, are refused.

        Raises:
            ConfigError: At the option or argument.
        """
        given = {} if ctx.resilient_parsing else self.make_parser(ctx).parse_args(args=list(args))[0]
        texts = [(parameter, text) for parameter in self.get_params(ctx) for text in _texts(given.get(parameter.name))]
        for parameter, text in texts:
            if not text.strip():
                raise ConfigError("is empty", where=_name(parameter), allowed="a value", hint=UNSET_HINT)
            if text == "-":
                raise ConfigError(
                    "'-' is not a value", where=_name(parameter), hint="give the name of a file; /dev/stdout is one"
                )
        left = super().parse_args(ctx, args)
        from lidardesign.run.yaml import plain_number

        for parameter, text in texts:
            value = ctx.params.get(parameter.name)
            values = value if isinstance(value, list | tuple) else [value]
            if all(isinstance(each, int | float) and not isinstance(each, bool) for each in values):
                try:
                    plain_number(text)
                except ValueError:
                    raise ConfigError(repr(text), where=_name(parameter), allowed="a finite number") from None
        return left


def _texts(given: Any) -> list[str]:
    """The values of a parameter that are texts of the command line, as a list."""
    return [text for text in (given if isinstance(given, list | tuple) else [given]) if isinstance(text, str)]


def _name(parameter: Any) -> str:
    """The name of a parameter on the command line."""
    return parameter.opts[0] if parameter.param_type_name == "option" else parameter.metavar or parameter.name
