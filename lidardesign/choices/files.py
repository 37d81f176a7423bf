"""The choices of commands that write or read what designs fire and see: `export`, `simulate`, `capture`, `show`."""

from pathlib import Path
from typing import Annotated, TypedDict

from lidardesign.choices.flag import Flag
from lidardesign.choices.shared import At, Detector, RayCount, SceneSettings, Seed, SpaceOf
from lidardesign.limits import MOST_PORT, MOST_SCENES

CLOUD_FORMATS = ("ply", "pcd", "mcap")


class ExportChoices(TypedDict, total=False):
    """A user's choices for an export."""

    rays: RayCount
    at: At
    rate_hz: Annotated[
        float | None,
        Flag(
            "--rate-hz",
            "HZ",
            "Frames per second, in formats that hold it.",
            "10, as in the read-out model",
            kind=float,
        ),
    ]
    robot: Annotated[
        Path | None,
        Flag(
            "--robot",
            "MODEL",
            "MuJoCo model to put the sensors on (mjcf).",
            "that of the run of a mounted design",
            kind=Path,
        ),
    ]


class ExportCommand(TypedDict, total=False):
    """The options of `export` beside these."""

    format: Annotated[str | None, Flag("--format", "NAME", "Format; --list shows them.", offers="formats")]
    out: Annotated[Path | str | None, Flag("--out", "PATH", "File to write.", "beside the design", kind=Path)]
    list_formats: Annotated[bool, Flag("--list", "", "List the formats.", default=False)]


class SimulateChoices(TypedDict, total=False):
    """A user's choices for what a design sees."""

    scenes: Annotated[int, Flag("--scenes", "N", "Number of held-out scenes.", None, 1, int, 1, MOST_SCENES)]
    scale: Annotated[float, Flag("--scale", "FACTOR", "From the unit of that mesh to metres.", default=1.0, kind=float)]
    rays: RayCount
    detector: Detector
    settings: SceneSettings
    seed: Seed


class SimulateCommand(TypedDict, total=False):
    """The options of `simulate` beside these."""

    out: Annotated[Path, Flag("--out", "PATH", "Folder to write; for mcap the file.", kind=Path, is_required=True)]
    format: Annotated[str, Flag("--format", "", "Format of the clouds.", default="ply", words=CLOUD_FORMATS)]
    scene: Annotated[Path | None, Flag("--scene", "FILE", "A mesh or MuJoCo model of your own instead.", kind=Path)]


class CaptureCommand(TypedDict, total=False):
    """The options of `capture`."""

    rays: RayCount
    at: At
    estimator: Annotated[
        str,
        Flag(
            "--estimator",
            "",
            "Range from the highest bin, or from the log-matched filter.",
            default="peak",
            words=("peak", "matched"),
        ),
    ]
    false_alarm: Annotated[
        float,
        Flag(
            "--false-alarm", "P", "Probability that background alone is taken for a return.", default=0.01, kind=float
        ),
    ]
    within_deg: Annotated[
        float | None,
        Flag(
            "--within-deg",
            "DEG",
            "Largest angle between a ray and the pixel that stands for it.",
            "the spacing of the pixels",
            kind=float,
        ),
    ]
    outlier_mm: Annotated[
        float, Flag("--outlier-mm", "MM", "Returns that are off by more are outliers.", default=10.0, kind=float)
    ]
    reference: Annotated[
        Path | None,
        Flag(
            "--reference",
            "MESH",
            "The true surface, in metres in the design's frame.",
            "through the capture's true ranges",
            kind=Path,
        ),
    ]
    csv: Annotated[Path | None, Flag("--csv", "FILE", "Write every ray's range and point as CSV.", kind=Path)]


class ShowCommand(TypedDict, total=False):
    """The options of `show`."""

    at: At
    space_of: SpaceOf


class StudioChoices(TypedDict, total=False):
    """A user's choices for the studio."""

    port: Annotated[
        int | None,
        Flag("--port", "N", "Port to listen on.", "any that is free", kind=int, low=1, high=MOST_PORT),
    ]


class StudioCommand(TypedDict, total=False):
    """The options of `studio` beside these."""

    no_browser: Annotated[bool, Flag("--no-browser", "", "Print the address alone.", default=False)]
