"""Learning a task into a run folder: the request, and the folder as it is started, resumed or removed."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.choices.flag import complete
from lidardesign.choices.learn import LearnChoices
from lidardesign.config import RunConfig, load_run_config, resolve, save_run_config
from lidardesign.errors import (
    BackgroundNote,
    ConfigError,
    DataError,
    ThresholdError,
    pasted,
)
from lidardesign.plugins import plugin_guard
from lidardesign.run.clock import WAIT_S, Clock, outermost_clock, phase
from lidardesign.run.files import exchange, is_held, is_temporary, named, remove, run_lock, writer
from lidardesign.run.manifest import note, start_manifest
from lidardesign.run.outputs import LOCK, check_writable, files_of_run
from lidardesign.run.yaml import leaves, load_yaml
from lidardesign.run_folder import (
    CONFIGURATION,
    DESIGN_FOLDER,
    INPUTS,
    MANIFEST,
    SAMPLES,
    Notes,
    RunFolder,
    input_hashes,
    input_paths,
    log_note,
    settings_texts,
)
from lidardesign.task import TASKS, FolderConfig, Task, load_task, notes_of

if TYPE_CHECKING:
    from lidardesign.density.training.learn import LearnProgress, LearnResult

# Endings of the folders beside a run that is replaced: of the new run, and of the old one for an instant.
NEW, OLD = ".new", ".old"
# A run has begun once it has its configuration, which is written last; snapshots are of no use without a checkpoint.
STARTED_FILES = {CONFIGURATION, MANIFEST, "progress.jsonl", "snapshots"}
CHECKPOINTS = "checkpoint*"
LEARNED_FILES = (
    CONFIGURATION, MANIFEST, "progress.jsonl", "checkpoint.safetensors", "flow.safetensors", SAMPLES, "snapshots/",
)  # fmt: skip
# Tolerances of the misplaced share that can be measured; a longer time budget is a mistake in the unit.
# A tolerance is met where the measured share is at most so many standard errors above it.
STANDARD_ERRORS = 2.0
# Of a run that ends by the clock; config.yaml has the steps that it took once it has ended.
MOST_STEPS = 100_000_000
NO_RUN, NO_RUN_HINT = "there is no run to resume", "leave out --resume to start one"


def learn_choices(given: LearnChoices) -> LearnChoices:
    """A user's choices for learning, complete.

    Raises:
        ConfigError: One is out of its limits, or the tolerance is given twice.
    """
    choices = complete(LearnChoices, given)
    if choices["tolerance"] is not None:
        said = [text for text in settings_texts(choices["settings"]) if text.startswith("learning.misplaced=")]
        if said:
            raise ConfigError(f"is given beside --set {said[0]}", where="--tolerance", allowed="one of the two")
    return choices


def overrides_of(choices: LearnChoices) -> tuple[str, ...]:
    """The settings, those that a tolerance stands for, and those of a time budget where none of them is set."""
    endless = () if choices["time_budget_s"] is None else (f"learning.steps={MOST_STEPS}", "learning.misplaced=0")
    tolerance = choices["tolerance"]
    given = settings_texts(choices["settings"]) + (() if tolerance is None else (f"learning.misplaced={tolerance}",))
    return *(text for text in endless if not any(one.startswith(text.split("=")[0]) for one in given)), *given


@dataclass(frozen=True, eq=False)
class LearnRequest:
    """A task to learn, with its settings and its folder.

    Arguments:
        task: The task.
        folder: The run folder.
        settings: The whole configuration.
        choices: The user's choices.
        begun: Whether a started run is resumed.
        replaces: Whether a run is in the folder, to be replaced once the new one is learned.
        command: The command line for the manifest.
    """

    task: Task
    folder: Path
    settings: RunConfig
    choices: LearnChoices
    begun: bool = False
    replaces: bool = False
    command: Sequence[str] = field(default_factory=lambda: tuple(sys.argv))

    @classmethod
    def resolve(cls, task: str | None, given: LearnChoices, notes: Notes = log_note) -> LearnRequest:
        """The request of a user's choices; without a task, the one that its files name.

        Raises:
            ConfigError: An unknown task, impossible settings, or a folder that is not empty.
            DataError: There is no run to resume.
        """
        choices = learn_choices(given)
        out, resumes = choices["out"], choices["resume"]
        config_file = None if choices["config"] is None else Path(choices["config"])
        wanted = {
            "preset": choices["preset"],
            "config_file": config_file,
            "overrides": overrides_of(choices),
            "seed": choices["seed"],
        }
        task = task or _task_named(config_file, Path(out) if resumes and out else None)
        plugin = load_task(task)
        folder = Path("runs") / task if out is None else Path(out)
        replaces = choices["overwrite"] and _holds_run(folder)
        place = next_to(folder, NEW) if replaces else folder
        if resumes and not place.is_dir():
            raise DataError(NO_RUN, where=str(place), hint=NO_RUN_HINT)
        begun = resumes and not _was_killed_before_it_began(place)
        if begun:
            plugin, settings = _resumed_settings(plugin, place, wanted)
            if settings.learning.steps == MOST_STEPS and choices["time_budget_s"] is None:
                raise ConfigError("the run ends by the clock", where="--resume", hint="add --time-budget SECONDS")
        else:
            if resumes:
                notes("the run has nothing to resume from yet; it starts from the beginning")
            check_can_start(place)
            settings = resolve(plugin, **wanted)
            if isinstance(settings.task, FolderConfig):
                inputs = {INPUTS: input_hashes(settings.task)}
                settings = replace(settings, task=settings.task.model_copy(update=inputs))
        request = cls(plugin, folder, settings, choices, begun, replaces)
        if replaces:
            recorded, kept = map(Path, sorted(files_of_run(folder))), named(list(map(str, unrecorded_files(folder))))
            designs = ", ".join(path.stem for path in recorded if path.parent.name == DESIGN_FOLDER)
            lost = f", with its designs ({designs})" if designs else ""
            stays = f"; what is not of the run stays: {kept}" if kept else ""
            notes(f"once it is learned it replaces the run {folder}{lost}{stays}")
        for line in RunFolder(place, plugin, settings).input_notes() if begun else ():
            notes(line)
        if begun and not request.has_checkpoint:
            notes("the run has no checkpoint yet; it starts from the beginning")
        return request

    @property
    def place(self) -> Path:
        """The folder to learn in: beside the run's own while that holds the run to be replaced."""
        return next_to(self.folder, NEW) if self.replaces else self.folder

    @property
    def has_checkpoint(self) -> bool:
        """True where a run is resumed that has a checkpoint."""
        return self.begun and any(self.place.glob(CHECKPOINTS))

    @phase("scenes")
    def task_notes(self) -> list[str]:
        """The task's own notes on its configuration, before anything takes time."""
        with plugin_guard(self.task.name):
            return notes_of(self.task, self.settings.task, self.settings.space)

    def scale_notes(self) -> list[str]:
        """Notes on lengths that do not fit together: of training scenes, which are made for it, the space and sigma.

        Raises:
            DataError: There are no training scenes.
        """
        from lidardesign.density.objective.prepare import training_scenes
        from lidardesign.density.objective.scale import scale_notes

        return scale_notes(training_scenes(self.task, self.settings), self.settings)

    def plan(self, remark: Notes | None = None) -> dict[str, Any]:
        """The document of `--dry-run --json`: what would be learned and written, how long it takes and how much memory.

        Arguments:
            remark: Called with what is wrong with lengths.

        Raises:
            ConfigError, DataError: Unusable settings or scenes, or a folder that cannot be written.
        """
        with phase("libraries"):
            from lidardesign.density.training.learn import forecast, prepare_training_data

        settings, writes = self.settings, [f"{self.folder}/{name}" for name in LEARNED_FILES]
        for path in writes:
            check_writable(Path(path), is_folder=path.endswith("/"))
        data = prepare_training_data(self.task, settings, remark)
        return {
            "dry_run": True,
            "reads": [str(path) for path in (self.choices["config"], *input_paths(settings.task)) if path],
            "writes": writes,
            "settings": settings.as_document(),
            "forecast": forecast(data, settings, self.place, self.choices["device"], self.choices["time_budget_s"]),
        }

    def run(self, progress: Callable[[LearnProgress], None] | None = None, remark: Notes | None = None) -> LearnResult:
        """Learn into the folder; a run that fails before anything was learned is removed.

        Arguments:
            progress: Called about every tenth step.
            remark: Called with what is wrong with lengths, before anything is learned.

        Raises:
            ConfigError, DataError: Unusable settings or scenes, or a folder that cannot be written.
            DivergenceError: Learning stayed non-finite; the last good checkpoint is kept.
        """
        result = self._learned(outermost_clock() or Clock(), progress, remark)
        if not self.replaces:
            return result
        note(self.place, learn={"run": str(self.folder)})
        put_in_place(self.folder)
        return replace(result, run=str(self.folder))

    def _learned(
        self, clock: Clock, progress: Callable[[LearnProgress], None] | None, remark: Notes | None
    ) -> LearnResult:
        with phase("libraries"):
            from lidardesign.density.training.learn import learn

        folder, settings, budget_s = self.place, self.settings, self.choices["time_budget_s"]
        with _new_folder(folder), run_lock(folder):
            if not self.begun:
                check_can_start(folder)  # another process may have been faster
            with self._undone_on_failure():
                if not self.begun:
                    # Write what the run is before anything is learned; the configuration last
                    start_manifest(folder, command=list(self.command), seed=settings.seed)
                    note(folder, plugin=TASKS.distribution_of(self.task.name), **{INPUTS: input_hashes(settings.task)})
                    save_run_config(settings, folder)
                try:
                    result = learn(
                        self.task,
                        settings,
                        folder,
                        resume=self.has_checkpoint,
                        device=self.choices["device"],
                        progress=progress,
                        is_over=None if budget_s is None else lambda _: clock.seconds >= budget_s,
                        remark=remark,
                    )
                except DataError as error:
                    # of errors about data, those that only ended the writing: a full disk
                    if not isinstance(error.__cause__, OSError):
                        raise
                    hint = f"{error.hint}; {self.resume_hint()}"
                    raise type(error)(error.message, where=error.where, hint=hint) from error.__cause__
        if budget_s is None:
            return result
        learning = settings.learning.model_copy(update={"steps": result.steps})
        save_run_config(replace(settings, learning=learning), folder)
        return replace(result, notes=(*result.notes, BackgroundNote(f"{result.steps} steps in {budget_s:g} s")))

    def resume_hint(self) -> str:
        """The last checkpoint and the command that resumes from it, for people."""
        checkpoints = sorted(path.name for path in self.place.glob(CHECKPOINTS))
        if not checkpoints:
            return "before the first checkpoint; nothing was kept"
        again = f"--out {pasted(self.folder)} {'--overwrite ' if self.replaces else ''}--resume"
        for option, value in (
            ("--tolerance", self.choices["tolerance"]),
            ("--time-budget", self.choices["time_budget_s"]),
        ):
            again += "" if value is None else f" {option} {value:g}"
        last = f"the last checkpoint is {self.place / checkpoints[-1]}"
        return f"{last}\n  continue with: lidardesign learn {self.task.name} {again}"

    @contextlib.contextmanager
    def _undone_on_failure(self) -> Iterator[None]:
        """Remove the files of a new run that fails before anything was learned."""
        try:
            yield
        except BaseException:
            entries = [entry for entry in self.place.glob("*") if entry.name != LOCK]
            nothing_learned = all(entry.name in STARTED_FILES or entry.stat().st_size == 0 for entry in entries)
            if not self.begun and nothing_learned:
                with contextlib.suppress(OSError):
                    # without its configuration a run has not begun, whatever else is left of it
                    (self.place / CONFIGURATION).unlink(missing_ok=True)
                    for entry in entries:
                        remove(entry)
            raise


def result_document(result: LearnResult) -> dict[str, Any]:
    """The document of `lidardesign learn --json`."""
    figures = ("task", "seconds", "steps", "ess", "kl_nats", "log_z", "coverage", "misplaced")
    return {
        "run": str(result.run),
        **{name: getattr(result, name) for name in figures},
        "verdict": result.verdict.word,
        "notes": list(result.notes),
        "error_estimates": result.as_dict()["error_estimates"],
    }


def check_tolerance(result: LearnResult, tolerance: float | None) -> None:
    """Check that learning reached a tolerance.

    Raises:
        ThresholdError: It did not; the message has the share that was reached.
    """
    error = result.error_estimates["misplaced"].error
    # without coverage the mass that the density missed is unknown
    if tolerance is None or (result.coverage > 0 and result.misplaced <= tolerance + STANDARD_ERRORS * (error or 0.0)):
        return
    doubt = "" if error is None else f" +- {error:.2g}"
    raise ThresholdError(
        f"{result.misplaced:.3g}{doubt} of the density's mass is in the wrong place after {result.steps} steps",
        where="--tolerance",
        allowed=f"at most {tolerance:g}",
        hint="a larger learning.steps, or --preset fine; the run is finished and can be used as it is",
    )


def _task_named(config_file: Path | None, run: Path | None) -> str:
    """The task that a configuration file names, or that of the run to resume.

    Raises:
        ConfigError: Neither names one.
        DataError: There is no such run.
    """
    resumed = () if run is None or not (run / CONFIGURATION).is_file() else (run / CONFIGURATION,)
    files = (*(() if config_file is None else (config_file,)), *resumed)
    named = [load_yaml(file, empty_sections=True).mapping.get("task_name") for file in files]
    if not any(named):
        if run is not None:
            raise DataError(NO_RUN, where=str(run), hint=NO_RUN_HINT)
        raise ConfigError(
            "no task was named",
            where="TASK",
            allowed=", ".join(TASKS.names()),
            hint="lidardesign learn TASK, or task_name: TASK in the file of --config",
        )
    return next(str(name) for name in named if name)


def check_can_start(run: Path) -> None:
    """Refuse a folder that holds anything, so that no run is ever overwritten.

    Raises:
        ConfigError: It is a file, or not empty.
    """
    if run.is_file():
        raise ConfigError("is a file", where=f"--out {run}", allowed="a folder that is new or empty")
    if run.is_dir() and not _was_killed_before_it_began(run):
        hint = "continue it with --resume, replace it with --overwrite, or give another --out"
        if run.name.endswith(NEW):
            hint = "an interrupted replacement: continue it with --overwrite --resume, or remove it"
        raise ConfigError("the folder is not empty", where=f"--out {run}", allowed="a new or empty folder", hint=hint)


def _holds_run(folder: Path) -> bool:
    """True where a folder has a run to replace; a folder without anything in it has none.

    Raises:
        ConfigError: It holds something else, is being written, or an earlier replacement was killed halfway.
    """
    where, aside = f"--out {folder}", next_to(folder, OLD)
    if folder.is_dir() and is_held(folder.resolve()):
        raise ConfigError(
            "is a mount point, or holds the working folder: it cannot be replaced",
            where=where,
            hint="give another --out",
        )
    if aside.exists():
        hint = f"remove it; if {folder} is not there: mv {pasted(next_to(folder, NEW))} {pasted(folder)}"
        raise ConfigError("is left over from a replacement that was killed", where=str(aside), hint=hint)
    if not folder.is_dir() or _was_killed_before_it_began(folder):
        return False
    if not (folder / MANIFEST).is_file():
        raise ConfigError("holds no run", where=where, allowed="--overwrite replaces runs", hint="give another --out")
    if at_work := writer(folder):
        raise ConfigError(f"{at_work} is writing this run", where=where, hint="wait for it, or use another --out")
    return True


def next_to(folder: Path, suffix: str) -> Path:
    """A run's folder with a suffix; of a link to it, beside the folder that the link leads to."""
    folder = folder.resolve() if folder.is_symlink() or folder.name in ("", "..") else folder
    return folder.with_name(folder.name + suffix)


def put_in_place(folder: Path) -> None:
    """Move the run that was learned beside a folder into its place, then delete the old one.

    What the old one did not record is in the new one too before it takes its place.

    Raises:
        DataError: Somebody is writing the old one, or the folders cannot be renamed; both are kept.
    """
    place, new, aside = (next_to(folder, suffix) for suffix in ("", NEW, OLD))
    try:
        with run_lock(place, wait_s=WAIT_S):
            # some may be there already, from a try that was killed
            for path in (one for one in unrecorded_files(place) if not os.path.lexists(new / one)):
                (new / path).parent.mkdir(parents=True, exist_ok=True)
                os.link(place / path, new / path, follow_symlinks=False)
            if exchange(new, place):
                new.rename(aside)
            else:
                place.rename(aside)
                try:
                    new.rename(place)
                except OSError:
                    aside.rename(place)
                    raise
    except (ConfigError, OSError) as error:
        reason = error.message if isinstance(error, ConfigError) else error.strerror or error
        hint = "the new run is finished: use it where it is, or move it"
        raise DataError(f"cannot replace {folder}: {reason}", where=str(new), hint=hint) from error
    # what cannot be removed is named by the next replacement
    shutil.rmtree(aside, ignore_errors=True)


def unrecorded_files(run: Path) -> list[Path]:
    """Paths in a run's folder of what the run did not record, so that it outlasts the run."""
    paths = [path for path in sorted(run.rglob("*")) if path.is_symlink() or not path.is_dir()]
    own = {*(run / name for name in files_of_run(run))}
    return [path.relative_to(run) for path in paths if path not in own and not is_temporary(path.name)]


def _was_killed_before_it_began(run: Path) -> bool:
    """True for a folder that is empty or holds only the files of a killed start."""
    names = {entry.name for entry in run.iterdir()}
    return CONFIGURATION not in names and all(
        name in STARTED_FILES or name == LOCK or is_temporary(name) for name in names
    )


def _resumed_settings(plugin: Task, run: Path, choices: Mapping[str, Any]) -> tuple[Task, RunConfig]:
    """The task and configuration of a run to resume; settings that differ from its own are refused."""
    task, stored = load_run_config(run)
    wanted = resolve(
        task if task.name == plugin.name else plugin,
        preset=choices["preset"] or stored.preset,
        config_file=choices["config_file"] or run / CONFIGURATION,
        overrides=choices["overrides"],
        seed=stored.seed if choices["seed"] is None else choices["seed"],
    )
    old, new = dict(leaves(stored.as_document())), dict(leaves(wanted.as_document()))
    for path in [*old, *new]:
        # hashes of input files are recorded, not set
        if path[:2] != ("task", INPUTS) and old.get(path) != new.get(path):
            raise ConfigError(
                f"the run was started with {'.'.join(map(str, path))} = {old.get(path)!r}, not {new.get(path)!r}",
                where=str(run / CONFIGURATION),
                hint="resume without options, or start a new run with another --out",
            )
    return task, stored


@contextlib.contextmanager
def _new_folder(run: Path) -> Iterator[None]:
    """Make the folder; remove it after a failure if it is empty."""
    new = [folder for folder in (run, *run.parents) if not folder.exists()]
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"cannot be made: {error.strerror or error}", where=f"--out {run}") from None
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            for folder in new:
                folder.rmdir()
        raise
