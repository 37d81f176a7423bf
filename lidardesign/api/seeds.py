"""Several runs of one task that differ in their seed: designs of one name scored in the same held-out scenes.

Every run brings its own designs, and baselines built from its own training scenes: the whole experiment is repeated,
from learning to the score.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.api.design import Design
from lidardesign.api.scores import ScoreOptions, ScoreRequest, Scores
from lidardesign.errors import ConfigError, DataError, names_arguments, pasted
from lidardesign.formats.designs import read_design
from lidardesign.run.clock import Progress, outermost_clock, running
from lidardesign.run_folder import Notes, RunFolder, log_note
from lidardesign.scoring.evaluation.request import usual_numbers
from lidardesign.scoring.evaluation.score import progress_of_part
from lidardesign.scoring.evaluation.seeds import over_seeds

if TYPE_CHECKING:
    from lidardesign.scoring.baselines.cma import Show

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


@names_arguments
def evaluate_seeds(
    runs: Sequence[RunFolder | Path | str],
    *,
    designs: Sequence[str] = (),
    rays: Sequence[int] | None = None,
    baselines: Sequence[str] = (),
    scenes_seed: int | None = None,
    effects: str = "auto",
    detector: str = "ideal",
    range_tolerance_mm: float | None = None,
    return_tolerance: float | None = None,
    settings: Sequence[str] | Mapping[str, Any] = (),
    mount_error: str | None = None,
    losses: bool = False,
    workers: int | str = 1,
    cma_seconds: float | None = None,
    fail_above: float | None = None,
    fail_unless_better: str | None = None,
    progress: Progress | None = None,
    notes: Notes = log_note,
) -> Scores:
    """Score the designs that have the same name in all runs, over seeds and held-out scenes.

    Arguments:
        runs: Two or more runs of one task that differ only in their seed, or their folders.
        designs: Names of designs; all that the runs have in common by default.
        rays: Numbers of rays per frame; the task's by default.
        baselines: Further baselines, as of `Run.evaluate`.
        scenes_seed: Seed of the held-out scenes; the first run's by default.
        effects: Physical effects: "auto", "all", "none" or names separated by commas.
        detector: The name of a detector, or a YAML file.
        range_tolerance_mm: Largest change of ranges by all skipped effects together [mm].
        return_tolerance: Largest share of returns changed by all skipped effects together.
        settings: Settings of the task, to score in scenes other than the learned ones.
        mount_error: Standard deviations of mounting errors of sensors in further rows, as "5mm,0.5deg".
        losses: Whether designs are scored with each of their sensors lost, too; those made for it always are.
        workers: Processes that score scenes, or the address of a dask scheduler, tcp://HOST:PORT.
        cma_seconds: Wall time of each search of the baseline cma [s].
        fail_above: Limit of the designs' values, in the metric's unit, for `Scores.check()`.
        fail_unless_better: Baseline or design that every other design must be better than, likewise.
        progress: Called with the name of the scene, the scenes done, and all scenes.
        notes: Called with every note.

    Raises:
        ConfigError: Runs that differ in more than their seed, a run given twice, or no design of one name.
        DataError: A run is missing or damaged.
    """
    opened = [run if isinstance(run, RunFolder) else RunFolder.open(run) for run in runs]
    options = ScoreOptions(
        designs=designs,
        rays=rays,
        baselines=baselines,
        scenes_seed=scenes_seed,
        effects=effects,
        detector=detector,
        range_tolerance_mm=range_tolerance_mm,
        return_tolerance=return_tolerance,
        settings=settings,
        mount_error=mount_error,
        losses=losses,
        workers=workers,
        cma_seconds=cma_seconds,
        fail_above=fail_above,
        fail_unless_better=fail_unless_better,
    )
    return SeedsRequest.resolve(opened, options, notes).score(progress)


@dataclass(frozen=True, eq=False)
class SeedsRequest:
    """An evaluation over seeds with nothing left open.

    Arguments:
        requests: One per run, in the same held-out scenes.
    """

    requests: Sequence[ScoreRequest]

    @classmethod
    def resolve(cls, runs: Sequence[RunFolder], options: ScoreOptions, notes: Notes = log_note) -> SeedsRequest:
        """The request of a user's choices.

        Arguments:
            runs: Runs that differ in their seed alone.
            options: The choices.
            notes: Called with every note.

        Raises:
            ConfigError: Runs that differ in more than their seed, a run given twice, or no design of one name.
            DataError: A run has no designs, or one cannot be read.
        """
        _check_runs(runs)
        _check_options(options)
        names = _common_names(runs, options.designs)
        designs = [
            [Design(read_design(path, notes), run, path) for path in map(run.design_path, names)] for run in runs
        ]
        every = [design.specification for of_run in designs for design in of_run]
        shared = replace(
            options,
            designs=(),
            rays=options.rays or usual_numbers(every, runs[0].task.defaults.rays),
            scenes_seed=runs[0].config.seed if options.scenes_seed is None else options.scenes_seed,
        )
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
            joint = over_seeds([each.evaluation for each in scores], seeds, self._scenes_seed)
            timings = clock.timings()
        return replace(scores[0], evaluation=joint, timings=timings)

    @property
    def _scenes_seed(self) -> int:
        request = self.requests[0]
        return request.seed if request.options.scenes_seed is None else request.options.scenes_seed


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
    ours, theirs = (_flat(run.config.as_document()) for run in (first, second))
    differing = (key for key in [*ours, *theirs] if key != SEED and ours.get(key) != theirs.get(key))
    return next(differing, None)


def _flat(document: Mapping[str, Any], front: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in document.items():
        flat |= _flat(value, f"{front}{key}.") if isinstance(value, Mapping) else {f"{front}{key}": value}
    return flat


def _check_options(options: ScoreOptions) -> None:
    if options.seed is not None:
        raise ConfigError(
            "every run has its own seed", where="--seed", hint="--scenes-seed chooses the held-out scenes"
        )
    for option, given in (("--accuracy", options.accuracy), ("--effects audit", options.effects.strip() == "audit")):
        if given:
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
