"""Choices that several commands have."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict

from lidardesign.choices.flag import Flag
from lidardesign.limits import MAX_SEED, MOST_RAYS

PRESETS = ("draft", "standard", "fine")

Seed = Annotated[
    int | None, Flag("--seed", "N", "Seed of all random numbers.", "the run's, or 0", None, int, 0, MAX_SEED)
]
RayCount = Annotated[
    int | None,
    Flag(
        "--rays",
        "N",
        "Rays per frame, over all sensors.",
        "the task's numbers; even rays leave it open",
        kind=int,
        low=1,
        high=MOST_RAYS,
    ),
]
At = Annotated[
    Mapping[str, float] | Sequence[str],
    Flag(
        "--at",
        "NAME=VALUE",
        "Value of a condition, such as the robot's position x_m=0.37; exact, no window. Repeatable.",
        default=(),
        is_repeated=True,
    ),
]
Detector = Annotated[
    Path | str,
    Flag(
        "--detector",
        "NAME|FILE",
        "The detector: ideal, single-photon, consumer-8x8, or a YAML file.",
        default="ideal",
        offers="detectors",
    ),
]
SceneSettings = Annotated[
    Sequence[str] | Mapping[str, Any],
    Flag(
        "--set",
        "KEY=VALUE",
        "A key of the task: choose in scenes other than the learned ones; repeatable.",
        default=(),
        is_repeated=True,
    ),
]
LearningSettings = Annotated[
    Sequence[str] | Mapping[str, Any],
    Flag(
        "--set",
        "KEY=VALUE",
        "Set one value, such as density.sigma_m=0.002 (`tasks show TASK` lists keys); repeatable.",
        default=(),
        offers="configuration_keys",
        is_repeated=True,
    ),
]
Workers = Annotated[
    int | str,
    Flag(
        "--workers",
        "N|tcp://HOST:PORT",
        "Look at scenes with this many processes on this machine, or with the workers of a dask scheduler (extra: "
        "cluster). The results are the same.",
        default="1",
    ),
]
Preset = Annotated[
    str | None,
    Flag("--preset", "", "Effort: about ten seconds, half a minute, or minutes.", "standard", words=PRESETS),
]
ConfigFile = Annotated[
    Path | str | None,
    Flag("--config", "FILE", "YAML file with any of the sections task, space, density, learning.", kind=Path),
]
SpaceOf = Annotated[
    Path | None,
    Flag(
        "--in",
        "RUN",
        "Take the task, its scenes and the design space of this run, for designs of any origin.",
        "the run that designs came from",
        kind=Path,
    ),
]
Json = Annotated[bool, Flag("--json", "", "Print one JSON document on stdout, for errors too.", default=False)]
Quiet = Annotated[
    bool,
    Flag("--quiet -q", "", "Print no notes or progress; for a result in a file, only its path.", default=False),
]
Verbose = Annotated[bool, Flag("--verbose -v", "", "Print everything: all tables and notes.", default=False)]


class Brief(TypedDict, total=False):
    """What a command prints that has nothing more to say."""

    json: Json
    quiet: Quiet


class Printed(Brief, total=False):
    """What a command prints."""

    verbose: Verbose


class Spoken(TypedDict, total=False):
    """What a command prints that has no document."""

    quiet: Quiet
    verbose: Verbose
