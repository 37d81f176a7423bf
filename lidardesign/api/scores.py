"""Scoring designs on held-out scenes: the request, resolved by runs and designs, and the scores."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.api.design import Design, collect_designs, html_table, name_apart, scoring_run, select_by_name
from lidardesign.config import with_task_settings
from lidardesign.errors import MAX_SEED, ConfigError, check_number, names_arguments
from lidardesign.fitting.fit import twin_samples, twin_without_visibility
from lidardesign.numerics import SLACK
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.run.clock import Progress, outermost_clock, phase, running
from lidardesign.run_folder import DESIGN_FOLDER, SAMPLES, Notes, RunFolder, log_note, settings_texts
from lidardesign.samples import load_samples
from lidardesign.scoring.baselines.cma import CMA, DEFAULT_SECONDS, CmaSettings
from lidardesign.scoring.baselines.simple import ALWAYS, BASELINES, NONE, check_baseline
from lidardesign.scoring.evaluation.headline import check_audit, check_better, check_limit
from lidardesign.scoring.evaluation.last_scores import SCORES, last_scores_of
from lidardesign.scoring.evaluation.mounting import MountError
from lidardesign.scoring.evaluation.request import EvaluationRequest, counts_without_baselines, usual_numbers
from lidardesign.scoring.evaluation.results import Evaluation, Paired, Row, write_csv
from lidardesign.scoring.evaluation.score import evaluate as score_designs
from lidardesign.sensors.sensor import MOST_RAYS
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.plan import Planner, Tolerance, parse_effects
from lidardesign.workers import check_workers, opened_workers

if TYPE_CHECKING:
    from lidardesign.report.figures import Figure
    from lidardesign.scoring.baselines.cma import Show

CMA_SECONDS = (0.1, 7 * 24 * 3600.0)
# A picometre, and further than any sensor reaches.
RANGE_TOLERANCES_MM = (SLACK, 1e9)
RETURN_TOLERANCES = (SLACK, 1.0)
MILLIMETRES = 1000.0
COMMAND = "evaluate"


@dataclass(frozen=True, kw_only=True)
class ScoreOptions:
    """A user's choices for an evaluation.

    Arguments:
        rays: Numbers of rays per frame; the task's by default, and the designs'.
        baselines: Further baselines beside uniform, random, bounding, silhouette and greedy, by name; ["none"] leaves
            out all of them.
        seed: Seed of all random numbers; the run's by default.
        effects: auto, all, none, audit, or names of effects between commas.
        detector: The name of a detector, or its file.
        range_tolerance_mm: Largest change of ranges by all skipped effects together [mm].
        return_tolerance: Largest share of returns changed by all skipped effects together.
        settings: Settings of the task to judge by other scenes than were learned.
        workers: Processes that score scenes, or the address of a scheduler.
        cma_seconds: Wall time of each search of the baseline cma [s].
        accuracy: Whether the sweeps of accuracy are measured, too.
        scenes_seed: Root of the held-out scenes; `seed` by default.
        designs: Names of the designs that are scored; all by default.
        mount_error: Standard deviations of mounting errors of sensors in further rows, as "5mm,0.5deg".
        losses: Whether designs are scored with each of their sensors lost, too; those made for it always are.
        fail_above: Limit of the designs' values, in the metric's unit, for `Scores.check`.
        fail_unless_better: Baseline or design that every other design must be better than, likewise.

    Raises:
        ConfigError: An option out of range or unknown.
    """

    rays: Sequence[int] | None = None
    baselines: Sequence[str] = ()
    seed: int | None = None
    effects: str = "auto"
    detector: str = "ideal"
    range_tolerance_mm: float | None = None
    return_tolerance: float | None = None
    settings: Sequence[str] | Mapping[str, Any] = ()
    workers: int | str = 1
    cma_seconds: float | None = None
    accuracy: bool = False
    scenes_seed: int | None = None
    designs: Sequence[str] = ()
    mount_error: str | None = None
    losses: bool = False
    fail_above: float | None = None
    fail_unless_better: str | None = None

    def __post_init__(self) -> None:
        check_workers(str(self.workers))
        self.misplacement()
        if NONE in self.baselines:
            if len(self.baselines) > 1 or self.fail_unless_better in BASELINES:
                raise ConfigError(
                    "none beside a baseline that this or --fail-unless-better names",
                    where="--baseline",
                    allowed="none alone",
                )
        else:
            for name in self.baselines:
                check_baseline(name, where="--baseline")
        limits = {
            "cma_seconds": CMA_SECONDS,
            "range_tolerance_mm": RANGE_TOLERANCES_MM,
            "return_tolerance": RETURN_TOLERANCES,
            "seed": (0, MAX_SEED),
            "scenes_seed": (0, MAX_SEED),
        }
        for name, (low, high) in limits.items():
            if getattr(self, name) is not None:
                check_number(getattr(self, name), f"--{name.replace('_', '-')}", low, high, whole="seed" in name)
        if self.fail_above is not None and not math.isfinite(self.fail_above):
            raise ConfigError(f"{self.fail_above}", where="--fail-above", allowed="a finite number")
        for count in self.rays or ():
            check_number(count, "--rays", 1, MOST_RAYS, whole=True)
        if self.cma_seconds is not None and CMA not in self.baselines:
            raise ConfigError(
                "there is no search", where="--cma-seconds", hint=f"add --baseline {CMA}, or leave it out"
            )

    def misplacement(self) -> MountError | None:
        """Standard deviations of misplaced sensors in further rows; None without these."""
        return None if self.mount_error is None else MountError.parse(self.mount_error)

    def planner(self) -> tuple[Planner, bool]:
        """The planner of effects, and True where skipped effects are audited.

        Raises:
            ConfigError: An unknown effect or detector.
        """
        audit = self.effects.strip() == "audit"
        choice = parse_effects("auto" if audit else self.effects)
        detector = load_detector(self.detector)
        tolerance = Tolerance.of(detector)
        if self.range_tolerance_mm is not None:
            tolerance = replace(tolerance, range_m=self.range_tolerance_mm / MILLIMETRES)
        if self.return_tolerance is not None:
            tolerance = replace(tolerance, lost=self.return_tolerance)
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
        options: The user's choices.
    """

    run: RunFolder
    learned: RunFolder
    designs: Sequence[Design]
    rays: Sequence[int]
    baselines: Sequence[str]
    seed: int
    planner: Planner
    audit: bool
    options: ScoreOptions

    @classmethod
    def resolve(
        cls,
        targets: Sequence[Design | Path],
        options: ScoreOptions,
        judge: RunFolder | None = None,
        notes: Notes = log_note,
    ) -> ScoreRequest:
        """The request of a user's choices.

        Arguments:
            targets: Designs, design files, and run folders, which stand for all their designs.
            options: The choices.
            judge: The run in whose scenes they are scored; by default a target without designs of its own, else the
                one that they came from.
            notes: Called with every note.

        Raises:
            ConfigError: Runs that differ, or invalid choices.
            DataError: A design or a run is not there, or damaged.
        """
        planner, audit = options.planner()
        runs = [RunFolder.open(target) for target in targets if isinstance(target, Path) and target.is_dir()]
        judge = judge or next((run for run in runs if not run.design_paths()), None)
        designs = select_by_name(collect_designs(targets, judge, notes, options.designs), options.designs)
        run = learned = scoring_run(name_apart(designs), judge, notes)
        for note in learned.input_notes():
            notes(note)
        baseline = options.fail_unless_better
        _check_baseline(baseline, [design.name for design in designs])
        baselines = (
            []
            if NONE in options.baselines
            else [*ALWAYS, *options.baselines, *([baseline] if baseline in BASELINES else [])]
        )
        rays = options.rays or usual_numbers([design.specification for design in designs], run.task.defaults.rays)
        if options.accuracy:
            # Refuse a run that is unfinished or damaged before it is evaluated, which may take minutes
            with phase("libraries"):
                from lidardesign.density.training.learned import check_kept

            check_kept(learned.folder)
        overrides = settings_texts(options.settings)
        if overrides:
            run = replace(run, config=with_task_settings(run.task, run.config, overrides))
        if options.range_tolerance_mm is None:
            planner = replace(planner, tolerance=planner.tolerated.within(run.metric))
        return cls(
            run,
            learned,
            designs,
            sorted(set(rays)),
            tuple(dict.fromkeys(baselines)),
            run.config.seed if options.seed is None else options.seed,
            planner,
            audit,
            options,
        )

    @property
    def alone(self) -> list[int]:
        """See `EvaluationRequest`."""
        return [] if self.options.rays else counts_without_baselines(self.rays, self.run.task.defaults.rays)

    @property
    def cma_seconds(self) -> float:
        """Wall time of each search of the baseline cma [s]."""
        return DEFAULT_SECONDS if self.options.cma_seconds is None else self.options.cma_seconds

    def evaluation_request(self, searching: Show | None = None) -> EvaluationRequest:
        """The request of the scoring itself, with scenes and samples.

        Arguments:
            searching: Called with how the searches of the baseline cma stand.
        """
        request = evaluation_request(
            self.run, self.designs, self.rays, self.baselines, self.seed, self.options.scenes_seed, self.learned
        )
        cma = CmaSettings(self.cma_seconds, show=searching)
        misplaced = self.options.misplacement()
        return replace(
            request,
            planner=self.planner,
            audit=self.audit,
            cma=cma,
            mount_error=misplaced,
            losses=self.options.losses,
            alone=self.alone,
            named=tuple(self.options.baselines),
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
            workers = check_workers(str(self.options.workers))
            with opened_workers(workers, request.task, len(request.test)) as starmap:
                evaluation = score_designs(replace(request, starmap=starmap), progress=progress)
            timings = clock.timings()
        return Scores(evaluation, replace(request, cma=replace(request.cma, show=None)), self.learned, timings, self)


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
        return {**self.evaluation.as_dict(), "set": list(settings_texts(self.request.options.settings))}

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
        return {SCORES: last_scores_of(self.evaluation, files, settings_texts(self.request.options.settings))}

    def with_accuracy(self, progress: Progress | None = None) -> Scores:
        """The scores, with what accuracy costs on this machine; takes minutes.

        Arguments:
            progress: Called with the name of the sweep, the sweeps done, and all sweeps.

        Raises:
            DataError: The run is unfinished or damaged.
        """
        run, request = self.run, self.evaluation_request
        # the density is that of the run's own scenes, whatever it is judged by
        if (request.config, request.seed) != (run.config.task, run.config.seed):
            request = replace(request, train=run.scenes("train", run.config.seed))
        with phase("accuracy"):
            from lidardesign.scoring.accuracy.evaluation import measure_accuracy
            from lidardesign.scoring.accuracy.probes import AccuracyRequest

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
    options = scores.request.options
    if options.fail_above is not None:
        check_limit(scores.evaluation, options.fail_above)
    if options.fail_unless_better is not None:
        check_better(scores.evaluation, options.fail_unless_better)
    check_audit(scores.evaluation)


def _check_baseline(name: str | None, designs: Sequence[str]) -> None:
    """Refuse a baseline or design that is unknown, or the only design."""
    where = "--fail-unless-better"
    if name is None or name in BASELINES:
        return
    if name not in designs:
        allowed = f"a baseline, or a design: {', '.join(designs)}"
        raise ConfigError(f"no baseline or design {name!r}", where=where, allowed=allowed)
    if len(designs) == 1:
        raise ConfigError(f"there is no other design to compare {name} with", where=where, hint="name a baseline")


def evaluation_request(
    run: RunFolder,
    designs: Sequence[Design],
    rays: Iterable[int],
    baselines: Sequence[str],
    seed: int | None = None,
    scenes_seed: int | None = None,
    learned: RunFolder | None = None,
) -> EvaluationRequest:
    """The request that scores designs in a run's scenes.

    Arguments:
        run: Whose task and configuration judge.
        designs: The designs.
        rays: Numbers of rays.
        baselines: By name.
        seed: Root of the random streams; None: the run's.
        scenes_seed: Root of the held-out scenes; None: `seed`.
        learned: The run as it was learned, where `run` judges by other settings.
    """
    config, learned = run.config, learned or run
    seed = config.seed if seed is None else seed
    from_runs = [design.specification for design in designs if design.run is not None]
    return EvaluationRequest(
        task=run.task,
        config=config.task,
        space=config.space,
        seed=seed,
        designs=[design.specification for design in designs],
        rays=sorted(set(rays)),
        baselines=tuple(dict.fromkeys(baselines)),
        train=run.scenes("train", seed),
        test=run.scenes("test", seed if scenes_seed is None else scenes_seed),
        scenes_seed=scenes_seed,
        without_visibility=None
        if not from_runs
        else partial(twin_without_visibility, from_runs[0], learned, samples=cache(partial(twin_samples, learned))),
        density=cache(
            lambda: load_samples(learned.folder, learned.config.space) if (learned.folder / SAMPLES).exists() else None
        ),
        training=TrainingScenes(run, seed),
    )
