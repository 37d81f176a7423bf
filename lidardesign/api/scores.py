"""Scoring designs on held-out scenes: the request, resolved by runs and designs, and the scores."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.api.contenders import collect_designs, name_apart, scoring_run, select_by_name
from lidardesign.api.design import Design, html_table
from lidardesign.choices.evaluate import EvaluateChoices, NamedChoices
from lidardesign.choices.flag import complete
from lidardesign.config import with_task_settings
from lidardesign.errors import ConfigError, names_arguments
from lidardesign.evaluation.headline import check_audit, check_better, check_limit
from lidardesign.evaluation.last_scores import SCORES, last_scores_of
from lidardesign.evaluation.mounting import MountError
from lidardesign.evaluation.request import (
    ALWAYS,
    NONE,
    EvaluationRequest,
    check_baseline,
    counts_without_baselines,
    usual_numbers,
)
from lidardesign.evaluation.results import Evaluation, Paired, Row, write_csv
from lidardesign.evaluation.score import evaluate as score_designs
from lidardesign.methods.cma import CMA, DEFAULT_SECONDS, CmaSettings
from lidardesign.methods.no_visibility import twin_samples, twin_without_visibility
from lidardesign.problem.method import METHODS
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.run.clock import Progress, outermost_clock, phase, running
from lidardesign.run_folder import DESIGN_FOLDER, SAMPLES, Notes, RunFolder, log_note, settings_texts
from lidardesign.samples import load_samples
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.plan import Planner, Tolerance, parse_effects
from lidardesign.workers import check_workers, opened_workers

if TYPE_CHECKING:
    from lidardesign.methods.cma import Show
    from lidardesign.report.figures import Figure

MILLIMETRES = 1000.0
COMMAND = "evaluate"


def score_choices(given: NamedChoices) -> NamedChoices:
    """A user's choices for an evaluation, complete.

    Raises:
        ConfigError: One is unknown or out of its limits, or two do not go together.
    """
    choices = complete(NamedChoices, given)
    check_workers(str(choices["workers"]))
    misplacement(choices)
    baselines, limit = choices["baselines"], choices["fail_above"]
    if NONE in baselines:
        if len(baselines) > 1 or choices["fail_unless_better"] in METHODS.names():
            raise ConfigError(
                "none beside a baseline that this or --fail-unless-better names",
                where="--baseline",
                allowed="none alone",
            )
    else:
        for name in baselines:
            check_baseline(name, where="--baseline")
    if limit is not None and not math.isfinite(limit):
        raise ConfigError(f"{limit}", where="--fail-above", allowed="a finite number")
    if choices["cma_seconds"] is not None and CMA not in baselines:
        raise ConfigError("there is no search", where="--cma-seconds", hint=f"add --baseline {CMA}, or leave it out")
    return choices


def misplacement(choices: EvaluateChoices) -> MountError | None:
    """Standard deviations of misplaced sensors in further rows; None without these."""
    return None if choices["mount_error"] is None else MountError.parse(choices["mount_error"])


def planner_of(choices: EvaluateChoices) -> tuple[Planner, bool]:
    """The planner of effects, and True where skipped effects are audited.

    Raises:
        ConfigError: An unknown effect or detector.
    """
    audit = choices["effects"].strip() == "audit"
    choice = parse_effects("auto" if audit else choices["effects"])
    detector = load_detector(str(choices["detector"]))
    tolerance = Tolerance.of(detector)
    if choices["range_tolerance_mm"] is not None:
        tolerance = replace(tolerance, range_m=choices["range_tolerance_mm"] / MILLIMETRES)
    if choices["return_tolerance"] is not None:
        tolerance = replace(tolerance, lost=choices["return_tolerance"])
    return Planner(detector, choice, tolerance), audit


@dataclass(frozen=True, eq=False)
class ScoreRequest:
    """An evaluation with nothing left open.

    Arguments:
        run: The run whose task scores, with the settings to score by.
        learned: The same run as it was learned.
        designs: The designs, by distinct names.
        rays: Numbers of rays.
        baselines: All of them, by name.
        seed: Root of the random streams.
        planner: The detector, and how effects are chosen.
        audit: Whether all rows are scored under all effects too.
        choices: The user's choices.
    """

    run: RunFolder
    learned: RunFolder
    designs: Sequence[Design]
    rays: Sequence[int]
    baselines: Sequence[str]
    seed: int
    planner: Planner
    audit: bool
    choices: NamedChoices

    @classmethod
    def resolve(
        cls,
        targets: Sequence[Design | Path],
        given: NamedChoices,
        judge: RunFolder | None = None,
        notes: Notes = log_note,
    ) -> ScoreRequest:
        """The request of a user's choices.

        Arguments:
            targets: Designs, design files, and run folders, which stand for all their designs.
            given: The choices that are given.
            judge: The run in whose scenes they are scored; by default a target without designs of its own, else the
                one that they came from.
            notes: Called with every note.

        Raises:
            ConfigError: Runs that differ, or invalid choices.
            DataError: A design or a run is not there, or damaged.
        """
        choices = score_choices(given)
        planner, audit = planner_of(choices)
        runs = [RunFolder.open(target) for target in targets if isinstance(target, Path) and target.is_dir()]
        judge = judge or next((run for run in runs if not run.design_paths()), None)
        designs = select_by_name(collect_designs(targets, judge, notes, choices["designs"]), choices["designs"])
        run = learned = scoring_run(name_apart(designs), judge, notes)
        for note in learned.input_notes():
            notes(note)
        baseline = choices["fail_unless_better"]
        _check_baseline(baseline, [design.name for design in designs])
        baselines = (
            []
            if NONE in choices["baselines"]
            else [*ALWAYS, *choices["baselines"], *([baseline] if baseline in METHODS.names() else [])]
        )
        rays = choices["rays"] or usual_numbers([design.specification for design in designs], run.task.defaults.rays)
        if choices["accuracy"]:
            # Refuse a run that is unfinished or damaged before it is evaluated, which may take minutes
            with phase("libraries"):
                from lidardesign.density.training.learned import check_kept

            check_kept(learned.folder)
        overrides = settings_texts(choices["settings"])
        if overrides:
            run = replace(run, config=with_task_settings(run.task, run.config, overrides))
        if choices["range_tolerance_mm"] is None:
            planner = replace(planner, tolerance=planner.tolerated.within(run.metric))
        return cls(
            run,
            learned,
            designs,
            sorted(set(rays)),
            tuple(dict.fromkeys(baselines)),
            run.config.seed if choices["seed"] is None else choices["seed"],
            planner,
            audit,
            choices,
        )

    @property
    def alone(self) -> list[int]:
        """See `EvaluationRequest`."""
        return [] if self.choices["rays"] else counts_without_baselines(self.rays, self.run.task.defaults.rays)

    @property
    def cma_seconds(self) -> float:
        """Wall time of each search of the baseline cma [s]."""
        return DEFAULT_SECONDS if self.choices["cma_seconds"] is None else self.choices["cma_seconds"]

    def evaluation_request(self, searching: Show | None = None) -> EvaluationRequest:
        """The request of the scoring itself, with scenes and samples.

        Arguments:
            searching: Called with how the searches of the baseline cma stand.
        """
        run, learned, seed, scenes_seed = self.run, self.learned, self.seed, self.choices["scenes_seed"]
        from_runs = [design.specification for design in self.designs if design.run is not None]
        return EvaluationRequest(
            task=run.task,
            config=run.config.task,
            space=run.config.space,
            seed=seed,
            designs=[design.specification for design in self.designs],
            rays=self.rays,
            baselines=self.baselines,
            train=run.scenes("train", seed) if self.baselines else (),  # for baselines alone
            test=run.scenes("test", seed if scenes_seed is None else scenes_seed),
            scenes_seed=scenes_seed,
            without_visibility=None
            if not from_runs
            else partial(twin_without_visibility, from_runs[0], learned, samples=cache(partial(twin_samples, learned))),
            density=cache(
                lambda: (
                    load_samples(learned.folder, learned.config.space) if (learned.folder / SAMPLES).exists() else None
                )
            ),
            training=TrainingScenes(run, seed),
            planner=self.planner,
            audit=self.audit,
            settings={CMA: CmaSettings(self.cma_seconds, show=searching)},
            mount_error=misplacement(self.choices),
            losses=self.choices["losses"],
            alone=self.alone,
            named=tuple(self.choices["baselines"]),
        )

    def score(self, progress: Progress | None = None, searching: Show | None = None) -> Scores:
        """Score every design and baseline on every held-out scene.

        Arguments:
            progress: Called with the name of the scene, the scenes done, and all scenes.
            searching: Called with how the searches of the baseline cma stand.

        Raises:
            ConfigError: No scenes, or an effect that was named and cannot be simulated here.
            PluginError: The task's score raised, or returned something that is no finite score.
        """
        with nullcontext(outermost_clock()) if outermost_clock() else running() as clock:
            request = self.evaluation_request(searching)
            workers = check_workers(str(self.choices["workers"]))
            with opened_workers(workers, request.task, len(request.test)) as starmap:
                evaluation = score_designs(replace(request, starmap=starmap), progress=progress)
            timings = clock.timings()
        return Scores(evaluation, replace(request, settings={}), self.learned, timings, self)


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of designs and baselines on held-out scenes, and their differences, scene by scene.

    `run.evaluate([...])` gives scores.

    Arguments:
        evaluation: Rows, differences, effects and notes.
        evaluation_request: What was evaluated.
        run: The run as it was learned.
        timings: Where the time went, seconds by phase.
        request: What was asked for.

    Example:
        >>> scores = run.evaluate([run.fit(sensors=2, rays=16, name="two")], rays=[16])
        >>> [row.design for row in scores.rows]
        ['two', 'uniform', 'random', 'bounding', 'silhouette', 'greedy']
        >>> [pair.b for pair in scores.paired]
        ['uniform', 'random', 'bounding', 'silhouette', 'greedy']
        >>> scores.to_csv("scores.csv").name
        'scores.csv'
    """

    evaluation: Evaluation
    evaluation_request: EvaluationRequest
    run: RunFolder
    timings: Mapping[str, float]
    request: ScoreRequest

    @property
    def rows(self) -> Sequence[Row]:
        """Designs, then baselines, at equal numbers of rays."""
        return self.evaluation.rows

    @property
    def paired(self) -> Sequence[Paired]:
        """Every design against every baseline and every later design, scene by scene."""
        return self.evaluation.paired

    def as_dict(self) -> dict[str, Any]:
        """The document of `lidardesign evaluate --json`."""
        return {**self.evaluation.as_dict(), "set": list(settings_texts(self.request.choices["settings"]))}

    def check(self) -> None:
        """Check the designs against the thresholds of the request.

        Raises:
            ThresholdError: One is worse than `fail_above`, or not better than `fail_unless_better`; or skipped effects
                change a score by more than the metric's tolerance, where that was audited.
        """
        names_arguments(check_scores)(self)

    def last_scores(self) -> dict[str, Any]:
        """The entry of the run's manifest: the scores of the designs that lie in the run."""
        folder = (self.run.folder / DESIGN_FOLDER).resolve()
        files = {one.name: one.path for one in self.request.designs if one.path and one.path.resolve().parent == folder}
        return {SCORES: last_scores_of(self.evaluation, files, settings_texts(self.request.choices["settings"]))}

    def with_accuracy(self, progress: Progress | None = None) -> Scores:
        """The scores, with what accuracy costs on this machine; takes minutes.

        Arguments:
            progress: Called with the name of the sweep, the sweeps done, and all sweeps.

        Raises:
            DataError: The run is unfinished or damaged.
        """
        run, request = self.run, self.evaluation_request
        # the density is that of the run's own scenes, whatever it is judged by
        if not request.train or (request.config, request.seed) != (run.config.task, run.config.seed):
            request = replace(request, train=run.scenes("train", run.config.seed))
        with phase("accuracy"):
            from lidardesign.evaluation.accuracy.evaluation import measure_accuracy
            from lidardesign.evaluation.accuracy.probes import AccuracyRequest

            accuracy = measure_accuracy(
                AccuracyRequest(run.config, run.folder, request, self.evaluation), progress=progress
            )
        return replace(self, evaluation=replace(self.evaluation, accuracy=accuracy))

    @phase("writing")
    def to_csv(self, path: Path | str) -> Path:
        """Write the rows as CSV."""
        write_csv(self.evaluation, Path(path))
        return Path(path)

    @phase("writing")
    def report(self, path: Path | str, command: Sequence[str] = ()) -> Path:
        """Write one HTML page: tables, curves, a 3D view, and how to get the same figures again.

        Arguments:
            path: The file.
            command: What the page says that it was made by; this program's arguments by default.
        """
        from lidardesign.report.page import evaluation_report, write_report

        run, request, clock = self.run, self.evaluation_request, outermost_clock()
        times = {**run.command_times(), COMMAND: self.timings if clock is None else clock.timings()}
        page = evaluation_report(self.evaluation, request, run.folder, run.config, times, command or sys.argv)
        write_report(page, Path(path))
        return Path(path)

    def figure(self, against: str = "rays") -> Figure:
        """The scores with their intervals against "rays" or "bandwidth" (plotly)."""
        from lidardesign.report.figures import scores_figure

        return scores_figure(self.evaluation, against)

    def __repr__(self) -> str:
        metric = self.evaluation.metric
        return f"<Scores: {metric.name} [{metric.unit}] over {self.evaluation.scenes} scenes, {len(self.rows)} rows>"

    def _repr_html_(self) -> str:
        metric = self.evaluation.metric
        headings = ("design", "rays", f"{metric.name} [{metric.unit}]", "95 % interval", "failures", "Mbit/s")
        rows = [
            (
                row.design,
                row.rays,
                f"{row.value:.4g}",
                "-" if row.ci_low is None else f"{row.ci_low:.4g} - {row.ci_high:.4g}",
                row.failures,
                f"{row.bandwidth_mbps:.4g}",
            )
            for row in self.rows
        ]
        caption = f"{metric.name}, {metric.better} is better, over {self.evaluation.scenes} held-out scenes"
        return html_table(caption, headings, rows)


def check_scores(scores: Scores) -> None:
    """As `Scores.check`, with errors in terms of command-line options."""
    choices = scores.request.choices
    if choices["fail_above"] is not None:
        check_limit(scores.evaluation, choices["fail_above"])
    if choices["fail_unless_better"] is not None:
        check_better(scores.evaluation, choices["fail_unless_better"])
    check_audit(scores.evaluation)


def _check_baseline(name: str | None, designs: Sequence[str]) -> None:
    """Refuse a baseline or design that is unknown, or the only design."""
    where = "--fail-unless-better"
    if name is None or name in METHODS.names():
        return
    if name not in designs:
        allowed = f"a baseline, or a design: {', '.join(designs)}"
        raise ConfigError(f"no baseline or design {name!r}", where=where, allowed=allowed)
    if len(designs) == 1:
        raise ConfigError(f"there is no other design to compare {name} with", where=where, hint="name a baseline")
