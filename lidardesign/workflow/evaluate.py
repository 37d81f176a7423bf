"""Scoring designs on held-out scenes: what is asked for, resolved by runs and designs, and the scores that it gives."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.config import with_task_settings
from lidardesign.design.compare import outside_notes
from lidardesign.errors import ConfigError
from lidardesign.evaluate.baselines.cma import DEFAULT_SECONDS, CmaSettings
from lidardesign.evaluate.baselines.greedy import GREEDY, GreedySource, greedy_rays
from lidardesign.evaluate.baselines.simple import ALWAYS, BASELINES
from lidardesign.evaluate.last_scores import SCORES, last_scores_of
from lidardesign.evaluate.options import ScoreOptions
from lidardesign.evaluate.request import EvaluationRequest, can_fire, fired_numbers, left_out, usual_numbers
from lidardesign.evaluate.results import Evaluation, Paired, Row, write_csv
from lidardesign.evaluate.scene_scores import Progress
from lidardesign.evaluate.score import evaluate as score_designs
from lidardesign.evaluate.thresholds import check_audit, check_better, check_limit
from lidardesign.evaluate.workers.pool import check_workers, workers_of
from lidardesign.run.clock import outermost_clock, phase, running
from lidardesign.samples import load_samples
from lidardesign.simulate.plan import Planner
from lidardesign.workflow.designs import Design, collect_designs, html_table, judging_run, name_apart, named
from lidardesign.workflow.run_folder import (
    CONFIGURATION,
    DESIGN_FOLDER,
    MANIFEST,
    SAMPLES,
    Notes,
    RequestPlan,
    RunFolder,
    last_time,
    log_note,
    settings_texts,
)
from lidardesign.workflow.run_samples import Layouts, twin_without_visibility
from lidardesign.workflow.select_rays import gate_margin_m, selection_scenes

if TYPE_CHECKING:
    from lidardesign.evaluate.baselines.cma import Show
    from lidardesign.evaluate.figures.scene_figure import FigureData
    from lidardesign.evaluate.report.figures import Figure

MOST_NAMED = 8
COMMAND = "evaluate"


@dataclass(frozen=True, eq=False)
class ScoreRequest:
    """An evaluation with nothing left open.

    Arguments:
        run: The run whose task judges, by the settings that are judged by.
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
        runs: Sequence[RunFolder] = (),
        notes: Notes = log_note,
    ) -> ScoreRequest:
        """The request of a user's choices.

        Arguments:
            targets: Designs, design files, and run folders, which stand for all their designs.
            options: The choices.
            runs: Runs that were opened for it; the first one's task judges.
            notes: Called with every note.

        Raises:
            ConfigError: Runs that differ, or choices that cannot be.
            DataError: A design or a run is not there, or damaged.
        """
        planner, audit = options.planner()
        designs, opened = collect_designs(targets, runs, notes)
        designs = named(designs, options.designs)
        run = learned = judging_run(name_apart(designs), opened, notes)
        for note in learned.input_notes():
            notes(note)
        rival = options.fail_unless_better
        _check_rival(rival, [design.name for design in designs])
        baselines = [*ALWAYS, *options.baselines, *([rival] if rival in BASELINES else [])]
        rays = options.rays or usual_numbers([design.specification for design in designs], run.task.defaults.rays)
        if options.accuracy:
            # Refuse a run that is unfinished or damaged before it is evaluated, which may take minutes
            with phase("libraries"):
                from lidardesign.density.learned import check_kept

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

    def plan(self, outputs: Mapping[str, Path | None] | None = None) -> RequestPlan:
        """What the evaluation would do.

        Arguments:
            outputs: Files that are to be written, by the option that says so; None for those that are not.

        Raises:
            ConfigError: No design can fire any of the numbers of rays.
        """
        run, options = self.run, self.options
        specifications = [design.specification for design in self.designs]
        counts = fired_numbers(specifications, self.rays)
        scored = sum(can_fire(design, count) for design in specifications for count in counts)
        choosable, notes = greedy_rays(run.task, len(run.conditions()), counts)
        baselines = [name for name in self.baselines if name != GREEDY or choosable]
        rows, matched = scored + len(baselines) * len(counts), scored * len(baselines)
        names = [design.name for design in specifications]
        listed = ", ".join(names[:MOST_NAMED])
        listed += f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        settings = {
            "--effects": options.effects,
            "--detector": options.detector,
            "--set": list(settings_texts(options.settings)) or None,
            "--mount-error": options.mount_error,
            "--accuracy": options.accuracy,
        }
        given = [f"{name} {value}" for name, value in settings.items() if isinstance(value, str)]
        given += [*(f"--set {text}" for text in settings["--set"] or ()), *["--accuracy"] * options.accuracy]
        written = [
            f"{path}/" if option == "--plots" else path for option, path in (outputs or {}).items() if path is not None
        ]
        return RequestPlan(
            COMMAND,
            [
                f"score {listed} in the held-out scenes of task {run.task.name}, with {', '.join(map(str, counts))} "
                "rays per frame",
                f"against {', '.join(baselines)}: {rows} rows at equal rays, up to {matched} at equal bandwidth",
                *left_out(specifications, self.rays),
                *notes,
                *(line for design in specifications for line in outside_notes(design, run.config.space)),
                *([f"with {', '.join(given)}"] if given else []),
            ],
            [
                *(design.name if design.path is None else design.path for design in self.designs),
                *(run.folder / name for name in (CONFIGURATION, MANIFEST, *([SAMPLES] if run.has_samples else ()))),
            ],
            [*written, run.folder / MANIFEST],
            {"designs": names, "rays": counts, "baselines": list(self.baselines), **settings},
            last_time(run.folder, COMMAND),
        )

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
        return replace(request, planner=self.planner, audit=self.audit, cma=cma, mount_error=misplaced)

    def score(self, progress: Progress | None = None, searching: Show | None = None) -> Scores:
        """Score every design and baseline on every held-out scene.

        Arguments:
            progress: Called with the scenes done, all scenes, and the name of the scene.
            searching: Called with how the searches of the baseline cma stand.

        Raises:
            ConfigError: No scenes, or an effect that was named and cannot be simulated here.
            PluginError: The task's score raised, or returned something that is no finite score.
        """
        with nullcontext(outermost_clock()) if outermost_clock() else running() as clock:
            request = self.evaluation_request(searching)
            with workers_of(check_workers(str(self.options.workers)), most=len(request.test)) as scorer:
                if scorer is not None:
                    scorer.prepare(request)
                scoring = request if scorer is None else replace(request, scorer=scorer)
                evaluation = score_designs(scoring, progress=progress)
            timings = clock.timings()
        return Scores(evaluation, replace(request, cma=replace(request.cma, show=None)), self.learned, timings, self)


@dataclass(frozen=True, eq=False)
class Scores:
    """What designs and baselines score on held-out scenes, and how they differ, scene by scene.

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
        """What `lidardesign evaluate --json` prints of them."""
        return {**self.evaluation.as_dict(), "set": list(settings_texts(self.request.options.settings))}

    def check(self) -> None:
        """Check the designs against the thresholds of the request.

        Raises:
            ThresholdError: One is worse than `fail_above`, or not better than `fail_unless_better`; or skipped effects
                change a score by more than the metric's tolerance, where that was audited.
        """
        options = self.request.options
        if options.fail_above is not None:
            check_limit(self.evaluation, options.fail_above)
        if options.fail_unless_better is not None:
            check_better(self.evaluation, options.fail_unless_better)
        check_audit(self.evaluation)

    def last_scores(self) -> dict[str, Any]:
        """What the run's manifest keeps of them: the scores of the designs that lie in the run."""
        folder = (self.run.folder / DESIGN_FOLDER).resolve()
        files = {one.name: one.path for one in self.request.designs if one.path and one.path.resolve().parent == folder}
        return {SCORES: last_scores_of(self.evaluation, files, settings_texts(self.request.options.settings))}

    def with_accuracy(self, progress: Progress | None = None) -> Scores:
        """The scores, with what accuracy costs on this machine; takes minutes.

        Arguments:
            progress: Called with the sweeps done, all sweeps, and the name of the sweep.

        Raises:
            DataError: The run is unfinished or damaged.
        """
        run, request = self.run, self.evaluation_request
        # the density is that of the run's own scenes, whatever it is judged by
        if (request.config, request.seed) != (run.config.task, run.config.seed):
            request = replace(request, train=run.scenes("train", run.config.seed))
        with phase("accuracy"):
            from lidardesign.evaluate.accuracy.probes import AccuracyRequest
            from lidardesign.evaluate.accuracy.sweeps import measure_accuracy

            accuracy = measure_accuracy(
                AccuracyRequest(run.config, run.folder, request, self.evaluation), progress=progress
            )
        return replace(self, evaluation=replace(self.evaluation, accuracy=accuracy))

    @phase("writing")
    def to_csv(self, path: Path | str) -> Path:
        """Write the rows as CSV."""
        write_csv(self.evaluation, Path(path))
        return Path(path)

    def figure_data(self) -> FigureData:
        """What pictures and reports draw in addition to the scores."""
        from lidardesign.evaluate.figures.scene_figure import figure_data

        clock = outermost_clock()
        times = {**self.run.command_times(), COMMAND: self.timings if clock is None else clock.timings()}
        return figure_data(self.evaluation, self.evaluation_request, times)

    @phase("writing")
    def plots(self, folder: Path | str, pictured: FigureData | None = None) -> list[Path]:
        """Write pictures for papers into a folder, as PNG and SVG."""
        from lidardesign.evaluate.figures.plots import write_plots

        return write_plots(self.evaluation, Path(folder), self.figure_data() if pictured is None else pictured)

    @phase("writing")
    def report(self, path: Path | str, command: Sequence[str] = (), pictured: FigureData | None = None) -> Path:
        """Write one HTML page: tables, curves, a 3D view, and how to get the same figures again.

        Arguments:
            path: The file.
            command: What the page says that it was made by; this program's arguments by default.
            pictured: What `figure_data` gave, to be used again.
        """
        from lidardesign.evaluate.report.report import evaluation_report, write_report

        pictured = self.figure_data() if pictured is None else pictured
        run, request = self.run, self.evaluation_request
        page = evaluation_report(self.evaluation, request, run.folder, run.config, pictured, command or sys.argv)
        write_report(page, Path(path))
        return Path(path)

    def figure(self, against: str = "rays") -> Figure:
        """The scores with their intervals against "rays" or "bandwidth" (plotly)."""
        from lidardesign.evaluate.report.figures import scores_figure

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


def _check_rival(name: str | None, designs: Sequence[str]) -> None:
    """Refuse a rival that nothing can be better than."""
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
    from_runs = [(design.specification, design.run) for design in designs if design.run is not None]
    layouts = Layouts.of(from_runs, learned)
    return EvaluationRequest(
        task=run.task,
        config=config.task,
        space=config.space,
        seed=seed,
        designs=[design.specification for design in designs],
        rays=sorted(set(rays)),
        baselines=tuple(dict.fromkeys(baselines)),
        samples=layouts.samples(from_runs),
        train=run.scenes("train", seed),
        test=run.scenes("test", seed if scenes_seed is None else scenes_seed),
        scenes_seed=scenes_seed,
        lay_out=layouts,
        without_visibility=(lambda: twin_without_visibility(from_runs[0][0], learned, layouts)) if from_runs else None,
        density=cache(lambda: load_samples(learned.folder, learned.config.space) if learned.has_samples else None),
        greedy=GreedySource(partial(selection_scenes, run, seed), gate_margin_m(run)),
    )
