"""The choices of `learn`."""

from pathlib import Path
from typing import Annotated, TypedDict

from lidardesign.choices.flag import Flag
from lidardesign.choices.shared import ConfigFile, LearningSettings, Preset, Seed
from lidardesign.limits import TIME_BUDGETS_S, TOLERANCES


class LearnChoices(TypedDict, total=False):
    """A user's choices for learning."""

    out: Annotated[Path | str | None, Flag("--out", "RUN", "Run folder to make.", "runs/TASK", kind=Path)]
    preset: Preset
    config: ConfigFile
    settings: LearningSettings
    seed: Seed
    device: Annotated[
        str,
        Flag(
            "--device",
            "",
            "Where to train the flow; auto uses a GPU if there is one.",
            default="auto",
            words=("auto", "cpu", "cuda"),
        ),
    ]
    resume: Annotated[
        bool, Flag("--resume", "", "Continue an interrupted run from its last checkpoint.", default=False)
    ]
    overwrite: Annotated[
        bool,
        Flag(
            "--overwrite",
            "",
            "Replace the run in the folder, and its designs, once the new one is learned.",
            default=False,
        ),
    ]
    tolerance: Annotated[
        float | None,
        Flag(
            "--tolerance",
            "SHARE",
            "Set learning.misplaced: learn until at most this share of the density's mass is in the wrong place; exit "
            "1 if the steps run out first.",
            None,
            None,
            float,
            *TOLERANCES,
        ),
    ]
    time_budget_s: Annotated[
        float | None,
        Flag(
            "--time-budget",
            "SECONDS",
            "Learn for this long, however good the density is; measuring it takes extra time.",
            None,
            None,
            float,
            *TIME_BUDGETS_S,
        ),
    ]


class LearnCommand(LearnChoices, total=False):
    """The options of `learn`."""

    dry_run: Annotated[
        bool,
        Flag(
            "--dry-run",
            "",
            "Check everything, say what would be written and how long it takes, and stop.",
            default=False,
        ),
    ]
