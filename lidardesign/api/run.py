"""Runs as users hold them: a task that was learned, whose density is fitted to, and whose scenes judge designs."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from lidardesign.api.design import Design, html_table
from lidardesign.api.learn import LearnRequest, check_tolerance
from lidardesign.api.problems import problem_of
from lidardesign.choices.evaluate import EvaluateChoices
from lidardesign.choices.flag import takes
from lidardesign.choices.learn import LearnChoices
from lidardesign.errors import DataError, LidardesignError, names_arguments, pasted
from lidardesign.fitting.options import DesignChoices
from lidardesign.formats.designs import folder_of, reach_of, read_design
from lidardesign.problem.method import DESIGN, METHODS
from lidardesign.run.clock import Progress
from lidardesign.run.files import writer
from lidardesign.run.manifest import DAMAGED_HINT, read_manifest
from lidardesign.run.outputs import CACHE
from lidardesign.run_folder import MANIFEST, Notes, RunFolder, log_note
from lidardesign.task import Metric

if TYPE_CHECKING:
    from lidardesign.api.scores import Scores
    from lidardesign.density.training.learned import LearnedDensity
    from lidardesign.samples import Verdict

FIGURES = ("ess", "kl_nats", "log_z", "coverage", "misplaced")


@dataclass(frozen=True)
class LearnedQuality:
    """The quality of a learned density.

    Arguments:
        ess: Effective share of the samples, 0 to 1.
        kl_nats: Divergence from the learned density to the target [nats].
        log_z: Log of the target's normalisation.
        coverage: Share of the target's mass that the density reaches.
        misplaced: Share of the density's mass in the wrong place.
        errors: The standard errors of these, where they are known.
    """

    ess: float
    kl_nats: float
    log_z: float
    coverage: float
    misplaced: float
    errors: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def verdict(self) -> str:
        """good, usable or poor."""
        return self._verdict.word

    def advice(self, preset: str) -> str | None:
        """The reason for the verdict and the next step after a preset; None where it is good."""
        return self._verdict.advice(preset) if self._verdict.why else None

    @property
    def _verdict(self) -> Verdict:
        from lidardesign.samples import Verdict

        return Verdict.of(self.misplaced, self.kl_nats, self.ess)


class Run(RunFolder):
    """A run folder: a task with its configuration, the density that was learned, and the designs fitted to it.

    `lidardesign.learn(task)` makes one, `lidardesign.open_run(folder)` opens one. Everything about it is in its folder,
    so commands and scripts can share runs.

    Arguments:
        folder: The folder.
        task: The task.
        config: The whole configuration.

    Example:
        >>> run = lidardesign.open_run(folder)
        >>> 0 < run.quality.ess <= 1
        True
        >>> run.density.sample(5).shape
        (5, 6)
        >>> design = run.fit(sensors=2, name="two")
        >>> design.save().name, [design.name for design in run.designs()]
        ('two.yaml', ['two'])
        >>> scores = run.evaluate([design], rays=[16])
        >>> scores.rows[0].design
        'two'
    """

    @property
    def quality(self) -> LearnedQuality:
        """The quality of the learned density.

        Raises:
            DataError: Learning did not end, or the manifest is damaged.
        """
        learned, where = read_manifest(self.folder).get("learn"), str(self.folder / MANIFEST)
        if learned is None:
            raise DataError("learning of the run was not finished", where=where, hint="continue with --resume")
        try:
            estimates = learned.get("error_estimates") or {}
            errors = {name: estimates[name].get("error") for name in FIGURES if name in estimates}
            return LearnedQuality(*(float(learned[name]) for name in FIGURES), errors)
        except (KeyError, TypeError, ValueError, AttributeError):
            raise DataError("the record of learning is damaged", where=where, hint=DAMAGED_HINT) from None

    @property
    def density(self) -> LearnedDensity:
        """The learned density: `sample(count)` and `log_prob(points)`; needs torch, and makes the training scenes."""
        from lidardesign.density.training.learned import LearnedDensity

        return LearnedDensity(self.folder, self.task, self.config)

    @takes(DesignChoices)
    def fit(
        self, *, notes: Notes = log_note, progress: Progress | None = None, **choices: Unpack[DesignChoices]
    ) -> Design:
        """Fit a design to the learned density; nothing is learned again, and nothing is saved yet.

        Arguments:
            choices: Those of `DesignChoices`.
            notes: Called with every note; they are logged by default.
            progress: Called with every step, as "choosing 361 rays", and twice None.

        Raises:
            ConfigError: Choices that do not fit together.
            DataError: The density is too rough to fit to.
            InfeasibleError: Constraints that contradict each other, or hold too little of the density.
        """
        request = problem_of(self, choices, notes=notes)
        return Design.fitted(request, workers=choices.get("workers", 1), notes=notes, progress=progress)

    def designs(self) -> list[Design]:
        """The designs that are saved in the run, by name."""
        return [Design(read_design(path), self, path) for path in self.design_paths()]

    def summary(self) -> dict[str, Any]:
        """The quality of the density, the designs with their last scores, and commands of the next steps.

        Also the size of the cache of training information, where fits have left one.

        Raises:
            DataError: The manifest is damaged.
        """
        manifest, config, at_work = read_manifest(self.folder), self.config, writer(self.folder)
        learned = manifest.get("learn")
        try:
            metric = self.metric
        except LidardesignError:  # of a task whose files are elsewhere
            metric = self.task.metric
        quality = None if learned is None else self.quality
        designs = [_design_entry(path, manifest) for path in self.design_paths()]
        cache = self.folder / CACHE
        return {
            "run": str(self.folder),
            "task": config.task_name,
            "preset": config.preset,
            "seed": config.seed,
            "metric": {"name": metric.name, "unit": metric.unit, "better": metric.better},
            "quality": None if quality is None else {name: getattr(quality, name) for name in FIGURES},
            "verdict": None if quality is None else quality.verdict,
            "advice": None if quality is None else quality.advice(config.preset),
            **{name: _figure(learned, name) for name in ("seconds", "steps")},
            "designs": designs,
            "cache": {"path": str(cache), "bytes": cache.stat().st_size} if cache.is_file() else None,
            "writer": at_work,
            "next": [] if learned is None and at_work else self._next_commands(designs, learned is not None, metric),
        }

    @names_arguments
    def baseline(
        self, baseline: str, *, rays: int | None = None, name: str | None = None, seed: int | None = None
    ) -> Design:
        """As `fit(method=...)`, which takes its place."""
        warnings.warn("use run.fit(method=...)", DeprecationWarning, stacklevel=3)
        return self.fit(method=baseline, rays=rays, name=name or f"{baseline}-rays", seed=seed)

    def _next_commands(self, designs: Sequence[Mapping[str, Any]], finished: bool, metric: Metric) -> list[str]:
        """Command lines of the next steps."""
        run = pasted(self.folder)
        if not finished:
            return [f"lidardesign learn {self.config.task_name} --out {run} --resume"]
        scored = [entry for entry in designs if entry["score"] is not None]
        unscored = [entry for entry in designs if entry["score"] is None and "error" not in entry]
        evaluating = [f"lidardesign evaluate {run} --report report.html"] if unscored else []
        if not scored:
            return evaluating or [f"lidardesign fit {run}"]
        best = (min if metric.better == "lower" else max)(scored, key=lambda entry: entry["score"]["value"])
        rays = best["score"]["rays"]
        return [
            *evaluating,
            f"lidardesign constrain {run} --set budget.rays={max(rays // 2, 1)} --name fewer",
            f"lidardesign export {pasted(best['path'])} --format csv --rays {rays} --out rays.csv",
        ]

    @takes(EvaluateChoices)
    def evaluate(
        self,
        designs: Sequence[Design | Path | str] | None = None,
        *,
        progress: Progress | None = None,
        notes: Notes = log_note,
        **choices: Unpack[EvaluateChoices],
    ) -> Scores:
        """Score designs on held-out scenes against uniform, random, bounding, silhouette and greedy.

        Arguments:
            designs: Designs and design files, of other runs too; all that are saved in the run by default.
            choices: Those of `EvaluateChoices`.
            progress: Called with the name of the scene, the scenes done, and all scenes.
            notes: Called with every note.

        Raises:
            ConfigError: Invalid choices.
            DataError: There are no designs, or one is not there.
        """
        from lidardesign.api.scores import ScoreRequest

        chosen = self.designs() if designs is None else designs
        targets = [design if isinstance(design, Design) else Path(design) for design in chosen]
        scores = ScoreRequest.resolve(targets, choices, self, notes).score(progress)
        return scores.with_accuracy(progress) if choices.get("accuracy") else scores

    def __repr__(self) -> str:
        return f"<Run {self.folder}: task {self.task.name}, preset {self.config.preset}, seed {self.config.seed}>"

    def _repr_html_(self) -> str:
        quality = self.quality
        rows: list[tuple[str, object]] = [
            ("task", self.task.name),
            ("preset", self.config.preset),
            ("seed", self.config.seed),
            *((name, f"{getattr(quality, name):.3f}") for name in FIGURES),
            ("designs", ", ".join(path.stem for path in self.design_paths()) or "none"),
        ]
        return html_table(f"run {self.folder}", (), rows)


def _figure(learned: Mapping[str, Any] | None, name: str) -> float | None:
    value = (learned or {}).get(name)
    return value if isinstance(value, int | float) else None


def _design_entry(path: Path, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """A design of a run and its last score; one that cannot be read says why."""
    from lidardesign.evaluation.last_scores import last_score

    entry: dict[str, Any] = {"name": path.stem, "path": str(path), "score": None}
    try:
        design, score = read_design(path), last_score(manifest, path)
    except LidardesignError as error:
        return {**entry, "error": error.message}
    shape = {"sensors": len(design.sensors), "rays": design.count, "layout": design.layout}
    return {**entry, **shape, "score": None if score is None else asdict(score)}


def open_run(folder: Path | str) -> Run:
    """Open a run folder that `learn` made.

    Raises:
        DataError: There is none, or it is damaged.
    """
    return Run.open(folder)


@takes(LearnChoices)
def learn(
    task: str | None = None,
    *,
    progress: Progress | None = None,
    notes: Notes = log_note,
    **choices: Unpack[LearnChoices],
) -> Run:
    """Learn where rays are worth firing for a task, into a run folder.

    Arguments:
        task: The name of a task; `lidardesign tasks` lists them. By default the one that `config` names.
        choices: Those of `LearnChoices`.
        progress: Called about every tenth step with "learning", the steps done, and all steps, where that is known.
        notes: Called with every note; they are logged by default.

    Raises:
        ConfigError: An unknown task, impossible settings, or a folder that is not empty.
        ThresholdError: The tolerance was not reached; the run is finished and can be opened.
    """
    request = LearnRequest.resolve(task, choices, notes)
    remark = cache(notes)  # every note once
    for note in request.task_notes():
        remark(note)
    result = request.run(progress and (lambda now: progress("learning", now.step, now.steps)), remark)
    for note in (*result.notes, f"the density is {result.verdict.text(request.settings.preset)}"):
        remark(note)
    check_tolerance(result, request.choices["tolerance"])
    return open_run(request.folder)


def load_design(path: Path | str, run: Run | None = None, notes: Notes = log_note) -> Design:
    """Load a design file, or the file of a rig: rays as CSV or NPZ, a MuJoCo model, an SDF file.

    Arguments:
        path: The file.
        run: The run in which it can be fitted again; by default the one that it names, if that exists.
        notes: Called with every note.

    Raises:
        ConfigError, DataError: It cannot be read.
    """
    path = Path(path)
    specification = read_design(path, notes, reach_of([run]) if run else None)
    folder = folder_of(specification, path)
    if run is None and folder is not None:
        try:
            run = open_run(folder)
        except LidardesignError as error:
            notes(f"the run of {path} cannot be opened: {error}")
    return Design(specification, run, path)


def fixed_methods() -> list[str]:
    """The names of methods that make a design of their own, the same for every scene."""
    working = [one for one in METHODS.listings() if one.error is None]
    return [one.name for one in working if DESIGN not in one.facts["needs"] and not one.facts["redrawn"]]
