"""How `evaluate` is told how long the baseline `cma` searches, and tells how the search stands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID

    from lidardesign.cli.output import Output
    from lidardesign.evaluate.cma.candidate import CmaSettings
    from lidardesign.evaluate.cma.search import Progress
    from lidardesign.task import Metric

CMA = "cma"
LEAST_SECONDS = 0.1
OPTION = "--cma-seconds"
CmaSeconds = Annotated[
    float | None,
    typer.Option(
        OPTION,
        metavar="SECONDS",
        help="Wall time of each search of `--baseline cma`: one per number of rays, and one per bandwidth of the first "
        "design.",
        show_default="60",
    ),
]


def check_cma_seconds(seconds: float | None, baselines: Sequence[str]) -> None:
    """Refuse a time that is none, or that nothing would take.

    Raises:
        ConfigError: It is so.
    """
    if seconds is None:
        return
    if not (math.isfinite(seconds) and seconds >= LEAST_SECONDS):
        raise ConfigError(f"{seconds:g} s", where=OPTION, allowed=f"a finite number from {LEAST_SECONDS:g}")
    if CMA not in baselines:
        raise ConfigError("nothing is searched for", where=OPTION, hint=f"add --baseline {CMA}, or leave it out")


def searching(seconds: float | None) -> CmaSettings:
    """The settings of searches that tell nobody how they stand."""
    from lidardesign.evaluate.cma.candidate import DEFAULT_SECONDS, CmaSettings
    from lidardesign.evaluate.cma.search import Budget

    return CmaSettings(Budget(DEFAULT_SECONDS if seconds is None else seconds))


def told(settings: CmaSettings, metric: Metric, console: Output, bar: RichProgress | None) -> CmaSettings:
    """The same settings with searches that show their best score in a bar; without one, when they begin."""
    lines: dict[str, TaskID] = {}
    begun: set[str] = set()

    def show(label: str, progress: Progress) -> None:
        if bar is None:
            if label not in begun:
                console.note(f"{label}: searching for {settings.budget.seconds:g} s ...")
            begun.add(label)
            return
        if label not in lines:
            lines[label] = bar.add_task(label, total=1.0, row="")
        bar.update(lines[label], completed=progress.share, row=f"best {progress.best:.4g} {metric.unit}")

    return replace(settings, show=show)
