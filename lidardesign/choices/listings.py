"""The choices of commands about what is there and how to begin: `catalog`, `tasks`, `config`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TypedDict

from lidardesign.choices.flag import Flag
from lidardesign.choices.shared import ConfigFile, LearningSettings, Preset, Seed
from lidardesign.limits import LAW_SECONDS, MOST_FITTED, MOST_RAYS

ARRANGEMENTS = ("interleaved", "beside")  # of several parts at one place
NewFile = Annotated[Path | None, Flag("--out", "FILE", "New file to write; none is overwritten.", "stdout", kind=Path)]


class PartChoices(TypedDict, total=False):
    """The options of `catalog list`."""

    own: Annotated[
        Sequence[Path],
        Flag(
            "--catalog",
            "PATH",
            "A part file of your own, or a folder of them; repeatable.",
            default=(),
            kind=Path,
            is_repeated=True,
        ),
    ]
    reflectance: Annotated[
        float | None,
        Flag(
            "--reflectance",
            "PERCENT",
            "Ranges that sources state for targets of this reflectance.",
            kind=float,
            low=0.01,
            high=100,
        ),
    ]
    klux: Annotated[
        float | None,
        Flag(
            "--klux",
            "KLUX",
            "Ranges that sources state for this ambient light.",
            kind=float,
            low=0,
            high=1000,
        ),
    ]


class PartPlace(TypedDict, total=False):
    """How a design of a part is made."""

    at_origin: Annotated[str | None, Flag("--at-origin", "X,Y,Z", "Where it stands, in metres.", "0,0,0")]
    azimuth: Annotated[
        float | None,
        Flag("--azimuth-deg", "DEG", "Azimuth of its forward axis.", "0", None, float, -360, 360),
    ]
    elevation: Annotated[
        float | None,
        Flag("--elevation-deg", "DEG", "Elevation of its forward axis.", "0", None, float, -90, 90),
    ]
    roll: Annotated[
        float | None, Flag("--roll-deg", "DEG", "Roll about its forward axis.", "0", None, float, -360, 360)
    ]
    rays: Annotated[int | None, Flag("--rays", "N", "Rays per frame.", "all that it has", None, int, 1, MOST_RAYS)]
    parts: Annotated[int | None, Flag("--parts", "N", "Parts.", "as many as the rays need", None, int, 1, MOST_FITTED)]
    arrange: Annotated[
        str | None,
        Flag(
            "--arrange",
            "",
            "Several parts share a field of view and interleave their rays, or have theirs side by side.",
            "interleaved",
            words=ARRANGEMENTS,
        ),
    ]


class NewDesign(TypedDict, total=False):
    """The design that `catalog show` writes."""

    out: Annotated[Path | None, Flag("--out", "FILE.yaml", "Write a design of the part.", kind=Path)]


class LawChoices(TypedDict, total=False):
    """The options of `check` of any plugin."""

    seconds: Annotated[
        float,
        Flag("--seconds", "S", "Longest time that one call may take.", None, 60.0, float, *LAW_SECONDS),
    ]


class CheckCommand(LawChoices, total=False):
    """The options of `tasks check`."""

    config: ConfigFile
    settings: LearningSettings
    seed: Seed


class NewCommand(TypedDict, total=False):
    """The options of `tasks new`."""

    out: Annotated[Path | None, Flag("--out", "DIR", "Where to, a new folder.", "lidardesign-NAME", kind=Path)]


class InitCommand(TypedDict, total=False):
    """The options of `config init`."""

    preset: Preset
    settings: LearningSettings
    out: NewFile
    seed: Seed


class SchemaCommand(TypedDict, total=False):
    """The options of `config schema`."""

    task: Annotated[str | None, Flag("--task", "TASK", "With config: include the keys of this task.")]
    out: NewFile
