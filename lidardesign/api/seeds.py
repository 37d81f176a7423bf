"""Several runs of one task that differ in their seed: designs of one name scored in the same held-out scenes.

Every run brings its own designs, and baselines built from its own training scenes: the whole experiment is repeated,
from learning to the score.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

from lidardesign.api.design import Design
from lidardesign.api.scores import ScoreRequest, Scores, score_choices
from lidardesign.choices.evaluate import NamedChoices
from lidardesign.choices.flag import takes
from lidardesign.errors import ConfigError, DataError, pasted
from lidardesign.evaluation.request import usual_numbers
from lidardesign.evaluation.score import progress_of_part
from lidardesign.evaluation.seeds import over_seeds
from lidardesign.formats.designs import read_design
from lidardesign.run.clock import Progress, outermost_clock, running
from lidardesign.run.yaml import leaves
from lidardesign.run_folder import Notes, RunFolder, log_note

if TYPE_CHECKING:
    from lidardesign.methods.cma import Show

FEWEST_RUNS = 2
SEED = "seed"


def differing_seeds(targets: Sequence[Path], notes: Notes = log_note) -> list[RunFolder]:
    """The targets as runs, where these differ in their seed alone; else an empty list.

    Raises:
        DataError: A folder is no run, or damaged.
    """
    if len(targets) < FEWEST_RUNS or not all(target.is_dir() for target in targets):
        return []
    runs = [RunFolder.open(target) for target in targets]
    seeds = {run.config.seed for run in runs}
    other = next((key for run in runs[1:] if (key := _other_setting(runs[0], run)) is not None), None)
    if other is not None and len(seeds) == len(runs):
        notes(f"the runs differ in {other}, not only in their seeds: their designs are compared side by side")
    return runs if other is None and len(seeds) > 1 else []


@takes(NamedChoices)
def evaluate_seeds(
    runs: Sequence[RunFolder | Path | str],
    *,
    progress: Progress | None = None,
    notes: Notes = log_note,
    **choices: Unpack[NamedChoices],
) -> Scores:
    """Score the designs that have the same name in all runs, over seeds and held-out scenes.

    Arguments:
        runs: Two or more runs of one task that differ only in their seed, or their folders.
        choices: Those of `NamedChoices`, but for a seed, accuracy and audits.
        progress: Called with the name of the scene, the scenes done, and all scenes.
        notes: Called with every note.

    Raises:
        ConfigError: Runs that differ in more than their seed, a run given twice, or no design of one name.
        DataError: A run is missing or damaged.
    """
    opened = [run if isinstance(run, RunFolder) else RunFolder.open(run) for run in runs]
    return SeedsRequest.resolve(opened, choices, notes).score(progress)


@dataclass(frozen=True, eq=False)
class SeedsRequest:
    """An evaluation over seeds with nothing left open.

    Arguments:
        requests: One per run, in the same held-out scenes.
    """

    requests: Sequence[ScoreRequest]

    @classmethod
    def resolve(cls, runs: Sequence[RunFolder], given: NamedChoices, notes: Notes = log_note) -> SeedsRequest:
        """The request of a user's choices.

        Arguments:
            runs: Runs that differ in their seed alone.
            given: The choices that are given.
            notes: Called with every note.

        Raises:
            ConfigError: Runs that differ in more than their seed, a run given twice, or no design of one name.
            DataError: A run has no designs, or one cannot be read.
        """
        choices = score_choices(given)
        _check_runs(runs)
        _check_choices(choices)
        names = _common_names(runs, choices["designs"])
        designs = [
            [Design(read_design(path, notes), run, path) for path in map(run.design_path, names)] for run in runs
        ]
        every = [design.specification for of_run in designs for design in of_run]
        scenes_seed = runs[0].config.seed if choices["scenes_seed"] is None else choices["scenes_seed"]
        rays = choices["rays"] or usual_numbers(every, runs[0].task.defaults.rays)
        shared: NamedChoices = {**choices, "designs": (), "rays": rays, "scenes_seed": scenes_seed}
        return cls(
            [ScoreRequest.resolve(of_run, shared, run, notes) for of_run, run in zip(designs, runs, strict=True)]
        )

    @property
    def run(self) -> RunFolder:
        """The first run, which reports and pictures show."""
        return self.requests[0].run

    @property
    def cma_seconds(self) -> float:
        """Wall time of each search of the baseline cma [s]."""
        return self.requests[0].cma_seconds

    def score(self, progress: Progress | None = None, searching: Show | None = None) -> Scores:
        """Score every run's designs and baselines, and take means over seeds.

        Arguments:
            progress: Called with the name of the scene, the scenes done, and all scenes of all seeds.
            searching: Called with how the searches of the baseline cma stand.

        Raises:
            ConfigError: No scenes, or an effect that was named and cannot be simulated here.
            PluginError: The task's score raised, or returned something that is no finite score.
        """
        with nullcontext(outermost_clock()) if outermost_clock() else running() as clock:
            scores = [
                request.score(progress_of_part(progress, number, len(self.requests)), searching)
                for number, request in enumerate(self.requests)
            ]
            seeds = [request.seed for request in self.requests]
            scenes_seed = self.requests[0].choices["scenes_seed"]  # the same for all
            joint = over_seeds([each.evaluation for each in scores], seeds, scenes_seed)
            timings = clock.timings()
        return replace(scores[0], evaluation=joint, timings=timings)


def _check_runs(runs: Sequence[RunFolder]) -> None:
    if len(runs) < FEWEST_RUNS:
        raise ConfigError(f"{len(runs)} run", where="runs", allowed=f"{FEWEST_RUNS} or more that differ in their seed")
    for number, run in enumerate(runs):
        other = _other_setting(runs[0], run)
        if other is not None:
            raise ConfigError(
                f"{runs[0].folder} and {run.folder} differ in {other}",
                where="runs",
                allowed="runs that differ only in their seed",
                hint="learn them with the same settings and another --seed",
            )
        for twin in (one for one in runs[:number] if one.config.seed == run.config.seed):
            raise ConfigError(
                f"{run.folder} is named twice"
                if twin.folder.resolve() == run.folder.resolve()
                else f"{twin.folder} and {run.folder} have the same seed, {run.config.seed}",
                where="runs",
                allowed="each run and each seed once",
                hint="learn one of them with another --seed",
            )


def _other_setting(first: RunFolder, second: RunFolder) -> str | None:
    """The first configuration key other than the seed in which two runs differ; None without one."""
    ours, theirs = (dict(leaves(run.config.as_document())) for run in (first, second))
    differing = (key for key in [*ours, *theirs] if key != (SEED,) and ours.get(key) != theirs.get(key))
    return next((".".join(part for part in key if isinstance(part, str)) for key in differing), None)


def _check_choices(choices: NamedChoices) -> None:
    if choices["seed"] is not None:
        raise ConfigError(
            "every run has its own seed", where="--seed", hint="--scenes-seed chooses the held-out scenes"
        )
    audits = choices["effects"].strip() == "audit"
    for option, is_given in (("--accuracy", choices["accuracy"]), ("--effects audit", audits)):
        if is_given:
            raise ConfigError("it works on one run", where=option, hint="give one run, or leave it out")


def _common_names(runs: Sequence[RunFolder], wanted: Sequence[str]) -> list[str]:
    """The wanted names of designs that all runs have; all common names by default."""
    sets = [{path.stem for path in run.design_paths()} for run in runs]
    for run, names in zip(runs, sets, strict=True):
        if not names:
            raise DataError(
                "the run has no designs yet", where=str(run.folder), hint=f"lidardesign fit {pasted(run.folder)}"
            )
    common = sorted(reduce(set.intersection, sets))
    if not common:
        raise ConfigError(
            "no design has the same name in all runs",
            where="runs",
            allowed="; ".join(
                f"{run.folder}: {', '.join(sorted(names))}" for run, names in zip(runs, sets, strict=True)
            ),
            hint="fit them with the same --name",
        )
    missing = [name for name in wanted if name not in common]
    if missing:
        raise ConfigError(f"not every run has a design {missing[0]!r}", where="--designs", allowed=", ".join(common))
    return list(dict.fromkeys(wanted)) or common
