"""The choices of `evaluate`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypedDict

from lidardesign.choices.flag import Flag
from lidardesign.choices.shared import Detector, Seed, SpaceOf, Workers
from lidardesign.limits import CMA_SECONDS, MAX_SEED, MOST_RAYS, RANGE_TOLERANCES_MM, RETURN_TOLERANCES


class EvaluateChoices(TypedDict, total=False):
    """A user's choices for an evaluation."""

    rays: Annotated[
        Sequence[int] | None,
        Flag(
            "--rays",
            "N",
            "Rays per frame and position; repeatable. Fixed patterns fire their own number, or an even subset where "
            "fewer are asked for.",
            "the task's and the designs'",
            kind=int,
            low=1,
            high=MOST_RAYS,
            is_repeated=True,
        ),
    ]
    baselines: Annotated[
        Sequence[str],
        Flag(
            "--baseline",
            "NAME",
            "A baseline in addition to uniform, random, bounding, silhouette and greedy: lloyd (like silhouette, "
            "denser where returns are frequent and surfaces large), occupancy (rays towards cells that targets "
            "occupy), no-visibility (the first design refitted to the density without its occlusion term; takes some "
            "seconds), or cma (direct optimisation of the first design's sensors on training scenes, for "
            "--cma-seconds). Repeatable. none: no baselines at all.",
            default=(),
            offers="methods",
            is_repeated=True,
        ),
    ]
    cma_seconds: Annotated[
        float | None,
        Flag(
            "--cma-seconds",
            "SECONDS",
            "Wall time of each search of `--baseline cma`, one per number of rays.",
            "60",
            None,
            float,
            *CMA_SECONDS,
        ),
    ]
    effects: Annotated[
        str,
        Flag(
            "--effects",
            "auto|all|none|audit|LIST",
            "Physical effects: auto for those that matter in each scene, all, none, or names separated by commas; "
            "audit: like auto, and every row under all effects too (exit 1 if a score moves by more than the metric's "
            "tolerance).",
            default="auto",
            words=("auto", "all", "none", "audit"),
            is_open=True,
        ),
    ]
    detector: Detector
    range_tolerance_mm: Annotated[
        float | None,
        Flag(
            "--range-tolerance-mm",
            "MM",
            "How much all skipped effects together may change ranges (rms).",
            "a tenth of a bin, or 1, and at most the metric's tolerance where it is a length",
            None,
            float,
            *RANGE_TOLERANCES_MM,
        ),
    ]
    return_tolerance: Annotated[
        float | None,
        Flag(
            "--return-tolerance",
            "SHARE",
            "Share of returns that all skipped effects together may change.",
            "0.001",
            None,
            float,
            *RETURN_TOLERANCES,
        ),
    ]
    settings: Annotated[
        Sequence[str] | Mapping[str, Any],
        Flag(
            "--set",
            "KEY=VALUE",
            "Score in scenes other than the learned ones: a key of the task, such as illuminance_lux=100000 or "
            "test=10, that does not change the design space; repeatable.",
            default=(),
            is_repeated=True,
        ),
    ]
    fail_above: Annotated[
        float | None,
        Flag("--fail-above", "VALUE", "Exit 1 if a design scores worse, in the metric's unit.", kind=float),
    ]
    fail_unless_better: Annotated[
        str | None,
        Flag(
            "--fail-unless-better",
            "NAME",
            "Exit 1 unless every design is better than this baseline or design at every number of rays, by the "
            "interval of the difference.",
        ),
    ]
    workers: Workers
    accuracy: Annotated[
        bool,
        Flag(
            "--accuracy",
            "",
            "Also measure what accuracy costs on this machine: errors and seconds of every numerical choice, for this "
            "task and run, and the cheapest setting that is good enough. Takes minutes.",
            default=False,
        ),
    ]
    mount_error: Annotated[
        str | None,
        Flag(
            "--mount-error",
            "LENGTH,ANGLE",
            "Also score all rows with every sensor misplaced at random in every scene, such as 5mm,0.5deg: standard "
            "deviations along and about each axis.",
        ),
    ]
    losses: Annotated[bool, Flag("--losses", "", "Also score designs with each sensor lost in turn.", default=False)]
    seed: Seed
    scenes_seed: Annotated[
        int | None,
        Flag(
            "--scenes-seed",
            "N",
            "Seed of the held-out scenes.",
            "--seed, or the (first) run's",
            None,
            int,
            0,
            MAX_SEED,
        ),
    ]


class NamedChoices(EvaluateChoices, total=False):
    """A user's choices for an evaluation of designs by their names."""

    designs: Annotated[
        Sequence[str],
        Flag("--designs", "NAME", "Only designs of this name; repeatable.", "all", (), is_repeated=True),
    ]


class EvaluateCommand(TypedDict, total=False):
    """The options of `evaluate` beside these."""

    space_of: SpaceOf
    report: Annotated[
        Path | None, Flag("--report", "FILE.html", "Write one HTML page: tables, curves, 3D view.", kind=Path)
    ]
    csv: Annotated[Path | None, Flag("--csv", "FILE", "Write the rows as CSV.", kind=Path)]
