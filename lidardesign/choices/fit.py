"""The choices of `fit` and `constrain`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict

from lidardesign.choices.flag import Flag
from lidardesign.choices.shared import At, RayCount, SceneSettings, Seed, Workers
from lidardesign.limits import LEVELS, MOST_FITTED, MOST_PATTERNS

BEST = "best"  # as many sensors as score best on training scenes
LAYOUTS, GATES = ("chosen", "even", "spinning"), ("sensor", "ray")
LEAST = ("bandwidth", "rays", "sensors", "parts")  # of what a design for a goal has as little as it can


CONSTRAINTS = Flag("--constraints", "FILE", "YAML file (config schema constraints).", kind=Path)


class FitChoices(TypedDict, total=False):
    """A user's choices for a fit; defaults follow from an earlier design, the constraints or the task."""

    sensors: Annotated[
        int | str | None,
        Flag(
            "--sensors",
            "N|N-M|best",
            "Number of sensors; best: by the task's score on training scenes; N-M: of parts, a table and the best.",
            "the design's, else best",
        ),
    ]
    layout: Annotated[
        str | None,
        Flag(
            "--layout",
            "",
            "Rays chosen on training scenes, even in the field of view, or on chosen rings.",
            "the design's, else chosen; even where rays cannot be chosen",
            words=LAYOUTS,
        ),
    ]
    method: Annotated[
        str | None,
        Flag(
            "--method",
            "NAME",
            "Make the design by a method: what --layout names, greedy, or another of `methods list`.",
            "that of --layout",
            offers="methods",
        ),
    ]
    rays: RayCount
    channels: Annotated[
        int | None,
        Flag(
            "--channels",
            "N",
            "Channels (chosen rings) per sensor in the layout spinning.",
            "the design's, else 16",
            kind=int,
            low=1,
            high=MOST_FITTED,
        ),
    ]
    gates: Annotated[
        str | None,
        Flag(
            "--gates",
            "",
            "One gate per sensor, or one per ray.",
            "the design's, else sensor; ray where rays are chosen along a condition",
            words=GATES,
        ),
    ]
    level: Annotated[
        float | None,
        Flag(
            "--level",
            "SHARE",
            "Share of rays and returns that fields of view and gates contain, such as 0.99.",
            "the design's, else 0.999 for chosen rays and the task's for others",
            None,
            float,
            *LEVELS,
        ),
    ]
    at: At
    weights: Annotated[
        Sequence[str] | Mapping[str, Any],
        Flag(
            "--weight",
            "KEY=VALUE",
            "Weight the learned density for another setting of the task, such as importance; nothing is learned "
            "again. Repeatable.",
            default=(),
            is_repeated=True,
        ),
    ]
    parts: Annotated[
        Sequence[str] | str | None,
        Flag(
            "--parts",
            "NAME,NAME|catalog",
            "Make the design of real parts (catalog names, NAME:MODE, part files), chosen with their poses; "
            "--sensors says how many.",
        ),
    ]
    modules: Annotated[
        int | None,
        Flag("--modules", "N", "This many modules with --fov and --zones.", kind=int, low=1, high=MOST_FITTED),
    ]
    fov: Annotated[str | None, Flag("--fov", "WxH", "Module field of view in degrees, such as 45x45.")]
    zones: Annotated[str | None, Flag("--zones", "CxR", "Module zones, such as 8x8.")]
    like: Annotated[
        Path | str | None,
        Flag(
            "--like",
            "RIG",
            "Use no more than an existing rig (a design, rays as CSV or NPZ, a MuJoCo model, an SDF file): as many "
            "sensors and rays, its places, fields of view and gates no wider. Your own constraints take precedence.",
            kind=Path,
        ),
    ]
    name: Annotated[
        str | None, Flag("--name", "NAME", "Name of the design: RUN/designs/NAME.yaml.", "fit or constrained")
    ]
    seed: Seed
    certify: Annotated[
        bool,
        Flag(
            "--certify",
            "",
            "Bound what any other choice could gain at every number of rays, not just the middle one.",
            default=False,
        ),
    ]
    detector: Annotated[
        Path | str | None,
        Flag(
            "--detector",
            "NAME|FILE",
            "Judge sets of parts and numbers of sensors under a detector (see `evaluate`).",
            "ideal",
            offers="detectors",
        ),
    ]
    settings: SceneSettings
    survive: Annotated[
        int | None,
        Flag("--survive", "0|1", "1: allow for the loss of any one sensor.", "0", kind=int, low=0, high=1),
    ]
    goal: Annotated[
        float | None, Flag("--goal", "SCORE", "Score to keep with as little as possible (see --least).", kind=float)
    ]
    least: Annotated[str | None, Flag("--least", "", "What --goal minimises; by default bandwidth.", words=LEAST)]
    adaptive: Annotated[
        int | None,
        Flag(
            "--adaptive",
            "N",
            "At most N patterns; returns pick the next one.",
            "1",
            kind=int,
            low=1,
            high=MOST_PATTERNS,
        ),
    ]
    workers: Workers


class ConstrainOptions(TypedDict, total=False):
    """The options that `constrain` has beside those of `fit`, and in place of them."""

    constraints: Annotated[Path | None, CONSTRAINTS]
    settings: Annotated[
        Sequence[str],
        Flag(
            "--set",
            "KEY=VALUE",
            "One constraint: gate.width_m.max=0.1, or a key of the task as for `fit`; repeatable.",
            default=(),
            offers="constraint_keys",
            is_repeated=True,
        ),
    ]
