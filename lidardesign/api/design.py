"""Designs as users hold them: a specification, the run and the file that it belongs to, and what its fit found.

Also several designs beside each other: collected, named apart, and the run in whose scenes all of them are scored.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.api.export import (
    DesignSource,
    Exported,
    ExportRequest,
    export_target,
    format_of,
)
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, DataError, check_number, names_arguments, pasted
from lidardesign.fitting.options import FitOptions
from lidardesign.fitting.request import FitRequest, FitResult
from lidardesign.formats.designs import need_run, reach_beside, read_design, relative_folder, run_of
from lidardesign.rays.information import FEW_SCENES
from lidardesign.run.clock import WAIT_S, Progress, phase
from lidardesign.run.manifest import locked_run, write_recorded
from lidardesign.run_folder import Notes, RunFolder, ignore, log_note, settings_texts
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.compare import outside_space
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_text, save_design
from lidardesign.task import moved_files, scoring_settings
from lidardesign.workers import check_workers, opened_workers

if TYPE_CHECKING:
    from lidardesign.clouds.seen import Measuring, SeenScene
    from lidardesign.report.figures import Figure

MOST_SCENES = 10_000


class Design(DesignSource):
    """A LiDAR design: sensors with their layout, the run that it was fitted in, and what the fit found.

    `run.fit(...)` and `load_design(path)` give designs. Lengths are metres, angles radians.

    Arguments:
        specification: Sensors, layout, number of rays, constraints and where they came from.
        run: The run that it was fitted in; None for somebody else's rig, or where the run is gone.
        path: Its file; None until it is saved.
        result: What the fit found: log-likelihood, checks of constraints, standard errors; None for a loaded one.

    Example:
        >>> design = run.fit(sensors=2, rays=16, name="two")
        >>> [sensor.name for sensor in design.specification.sensors]
        ['s0', 's1']
        >>> design.rays(16).direction.shape
        (16, 3)
        >>> narrow = design.constrain(constraints={"gate": {"width_m": {"max": 0.3}}}, name="narrow")
        >>> narrow.result.satisfied
        True
        >>> narrow.save().name
        'narrow.yaml'
    """

    def __init__(
        self,
        specification: DesignSpec,
        run: RunFolder | None = None,
        path: Path | None = None,
        result: FitResult | None = None,
    ) -> None:
        super().__init__(specification, run, path)
        self.result = result

    @classmethod
    def fitted(
        cls,
        request: FitRequest,
        *,
        workers: int | str = 1,
        notes: Notes = log_note,
        progress: Progress | None = None,
    ) -> Design:
        """The design that a request comes to; it is not saved yet. `progress` is called with every step."""
        from lidardesign.fitting.fit import fit_design

        steps = ignore if progress is None else (lambda step: progress(step, None, None))
        with opened_workers(check_workers(str(workers)), request.run.task, FEW_SCENES) as starmap:
            result = fit_design(request, notes=notes, progress=steps, starmap=starmap)
        return cls(result.design, request.run, None, result)

    @property
    def name(self) -> str:
        """Its name: that of its file and of its rows."""
        return self.specification.name

    @names_arguments
    def constrain(
        self,
        *,
        sensors: int | str | None = None,
        constraints: Constraints | Mapping[str, Any] | Path | str | None = None,
        rays: int | None = None,
        layout: str | None = None,
        channels: int | None = None,
        gates: str | None = None,
        level: float | None = None,
        at: Mapping[str, float] | None = None,
        weights: Sequence[str] | Mapping[str, Any] = (),
        parts: Sequence[str] | str | None = None,
        like: Path | str | None = None,
        name: str | None = None,
        seed: int | None = None,
        certify: bool = False,
        detector: Path | str | None = None,
        settings: Sequence[str] | Mapping[str, Any] = (),
        survive: int | None = None,
        goal: float | None = None,
        least: str | None = None,
        adaptive: int | None = None,
        workers: int | str = 1,
        notes: Notes = log_note,
        progress: Progress | None = None,
    ) -> Design:
        """Fit it again in its run; what is not given stays as it is.

        Arguments:
            sensors: How many, or "best": as many as score best on training scenes.
            constraints: Constraints, a mapping of them, or a YAML file of them.
            rays: Rays per frame over all sensors.
            layout: chosen, even or spinning.
            channels: Rings of each sensor of the layout spinning.
            gates: "sensor" or "ray": one gate per sensor, or one per ray.
            level: The share of rays and returns that fields of view and gates contain.
            at: Values of conditions that the design is for, such as {"x_m": 0.37}.
            weights: Settings of the task towards which the learned density is weighted.
            parts: Real parts that the design is made of: names, NAME:MODE, paths of part files, or "catalog".
            like: The file of a rig to be like: as many sensors at its places, none wider, as many rays.
            name: The design's name; "constrained" by default.
            seed: Seed of all random numbers; the run's by default.
            certify: Whether every number of rays gets a certificate, not the middle one alone.
            detector: The detector that judges sets of parts and numbers of sensors: a name, or a YAML file.
            settings: Settings of the task, to choose in scenes other than the learned ones.
            survive: 1: rays are chosen for the loss of any one sensor, too; by default as constraints say.
            goal: The score that it has to keep on training scenes that were held back, in the metric's unit.
            least: What it then has the least of: bandwidth (the default), rays, sensors or parts.
            adaptive: At most so many patterns follow what they see; 1 for none.
            workers: Processes that look at training scenes, or the address of a dask scheduler, tcp://HOST:PORT.
            notes: Called with every note.
            progress: Called with every step, as "choosing 361 rays", and twice None.

        Raises:
            DataError: The run has gone.
            InfeasibleError: Constraints that contradict each other, or hold too little of the density.
        """
        run = need_run(self.run, self.name if self.path is None else self.path)
        options = FitOptions(
            sensors=sensors,
            constraints=constraints,
            rays=rays,
            layout=layout,
            channels=channels,
            gates=gates,
            level=level,
            at=at or {},
            weights=weights,
            parts=parts,
            like=like,
            name=name,
            seed=seed,
            certify=certify,
            detector=detector,
            settings=settings,
            survive=survive,
            goal=goal,
            least=least,
            adaptive=adaptive,
        )
        request = FitRequest.resolve(run, options, self.specification, notes=notes)
        return Design.fitted(request, workers=workers, notes=notes, progress=progress)

    def remounted(self, sensor: int, origin_m: Sequence[float], frame: np.ndarray) -> Design:
        """The design with one sensor at another pose; its rays go with it, and nothing is chosen again.

        Arguments:
            sensor: The sensor's number.
            origin_m: Its new place [m].
            frame: Its new axes, rows forward, horizontal, vertical, shape (3, 3).
        """
        return Design(self.specification.remounted(sensor, np.asarray(origin_m), frame), self.run)

    @names_arguments
    def rays(self, count: int | None = None, *, at: Mapping[str, float] | None = None, notes: Notes = log_note) -> Rays:
        """The explicit rays that it fires: origins, directions and gates, by ray.

        Arguments:
            count: How many; its own by default, or the largest number of its task.
            at: Values of conditions, as {"x_m": 0.37}.
            notes: Called with every note.
        """
        return self.specification.rays(self.usual_count(notes) if count is None else count, at)

    @phase("writing")
    def save(self, path: Path | str | None = None) -> Path:
        """Write its file: into its run, where the manifest records it, or to a path of your own.

        Raises:
            ConfigError: Another process writes the run.
            DataError: It has no run, or the file cannot be written.
        """
        if path is None:
            run = need_run(self.run, self.name)
            self.path = run.design_path(self.name)
            content = design_text(self.specification, self.path).encode()
            # several designs may be fitted to one run at once; each holds the lock for an instant
            with locked_run(run.folder, run.created, WAIT_S):
                write_recorded(run.folder, self.path.relative_to(run.folder).as_posix(), content)
            return self.path
        path, origin = Path(path), dict(self.specification.provenance)
        if self.run is not None and "run" in origin:
            origin["run"] = relative_folder(self.run.folder, path)
        self.specification = replace(self.specification, provenance=origin)
        save_design(self.specification, path)
        self.path = path
        return path

    @names_arguments
    def export(
        self,
        path: Path | str | None = None,
        format: str | None = None,
        *,
        rays: int | None = None,
        at: Mapping[str, float] | None = None,
        rate_hz: float | None = None,
        robot: Path | None = None,
        notes: Notes = log_note,
    ) -> Exported:
        """Write it for another program.

        Arguments:
            path: The file or folder; beside its own file by default.
            format: As `lidardesign export --list` shows them; by default what the path's ending says.
            rays: Rays per frame.
            at: Values of conditions.
            rate_hz: Frames per second, in formats that hold them [Hz].
            robot: A robot's MuJoCo model that the sensors are put into (mjcf).
            notes: Called with every note.
        """
        out = None if path is None else Path(path)
        chosen = format_of(format, out)
        target = export_target(self.path, out, chosen.suffix)
        return ExportRequest(self, chosen, target, rays, at or {}, rate_hz, robot).write(notes=notes)

    @names_arguments
    def simulate(
        self,
        scene: Path | str | Sequence[Scene] | None = None,
        *,
        scenes: int = 1,
        rays: int | None = None,
        detector: str = "ideal",
        settings: Sequence[str] | Mapping[str, Any] = (),
        seed: int | None = None,
        scale: float = 1.0,
        notes: Notes = log_note,
    ) -> list[SeenScene]:
        """What it sees in held-out scenes, with the effects that they call for, or in a mesh or robot of your own.

        Arguments:
            scene: A mesh file, a MuJoCo model in its initial configuration, or scenes of its run, as `run.scenes` gives
                them; None: held-out ones.
            scenes: How many held-out scenes.
            rays: Rays per frame; its own by default, or the largest number of its task.
            detector: The name of a detector, or its file.
            settings: Settings of the task, for scenes other than the learned ones.
            seed: Seed of all random numbers; the run's by default.
            scale: Factor from the unit of a mesh to metres (0.001 for mm).
            notes: Called with every note.

        Raises:
            ConfigError: An unknown choice, or no run to take scenes from.
            DataError: The file of the scene cannot be read.
        """
        from lidardesign.clouds.seen import Measuring

        measuring = Measuring(detector, seed)
        return self.seen(measuring, scene, scenes=scenes, rays=rays, settings=settings, scale=scale, notes=notes)

    def seen(
        self,
        measuring: Measuring,
        scene: Path | str | Sequence[Scene] | None,
        *,
        scenes: int,
        rays: int | None,
        settings: Sequence[str] | Mapping[str, Any],
        scale: float,
        notes: Notes,
    ) -> list[SeenScene]:
        """As `simulate`, with errors in terms of command-line options."""
        from lidardesign.clouds.seen import scene_of_file, seen_in_file, seen_scenes

        check_number(scenes, "--scenes", 1, MOST_SCENES, whole=True)
        count, spec = self.usual_count(notes) if rays is None else rays, self.specification
        if scene is None:
            run = need_run(self.run, self.name)
            for note in run.input_notes():
                notes(note)
            found = seen_scenes(run, spec, count, scenes, measuring, settings_texts(settings))
            if len(found) < scenes:
                notes(f"there are {len(found)} held-out scenes; --set test=N makes more, where the task has that key")
            return found
        if not isinstance(scene, Path | str):
            return seen_scenes(need_run(self.run, self.name), spec, count, scene, measuring, settings_texts(settings))
        if settings or scenes != 1 or spec.condition is not None:
            fault = "a design whose rays follow a condition" if spec.condition is not None else "--set or --scenes"
            raise ConfigError(f"{fault} together with a scene of your own", where="--scene", allowed="held-out scenes")
        if spec.following(count) is not None:
            notes("in a scene of your own the best single pattern fires")
        if measuring.seed is None and self.run is not None:
            measuring = replace(measuring, seed=self.run.config.seed)
        return [seen_in_file(scene_of_file(Path(scene), spec.mount, scale), spec, count, measuring)]

    def figure(self, count: int | None = None) -> Figure:
        """Its sensors in space, with fields of view and gates, and its rays where their number is given (plotly)."""
        from lidardesign.report.figures import design_figure

        return design_figure(self.specification, None if count is None else self.rays(count))

    def as_dict(self) -> dict[str, Any]:
        """The document of `lidardesign fit --json`: sensors, and what the fit found."""
        place = self.name if self.path is None else str(self.path)
        certificates = [*self.specification.certificates]
        further: dict[str, Any] = {"certificates": certificates} if certificates else {}
        if (adaptive := self.specification.adaptive) is not None:
            further["adaptive"] = {"looks": adaptive.rule.looks, "shares": adaptive.shares.tolist()}
        if self.result is None:
            sensors = [sensor.as_dict() for sensor in self.specification.sensors]
            return {"design": place, "frame": self.specification.mount or "world", "sensors": sensors, **further}
        return {**self.result.as_dict(), "design": place, **further}

    def __repr__(self) -> str:
        spec = self.specification
        rays = "rays left open" if spec.count is None else f"{spec.count} rays"
        sensors = "1 sensor" if len(spec.sensors) == 1 else f"{len(spec.sensors)} sensors"
        return f"<Design {self.name}: {sensors}, layout {spec.layout}, {rays}>"

    def _repr_html_(self) -> str:
        spec = self.specification
        rows = [{**sensor.as_text(), "weight": f"{sensor.weight:.3f}"} for sensor in spec.sensors]
        return html_table(f"{repr(self)[1:-1]}, in {spec.frame}", list(rows[0]), [list(row.values()) for row in rows])


@phase("designs")
def collect_designs(
    targets: Sequence[Design | Path], judge: RunFolder | None = None, notes: Notes = log_note, names: Sequence[str] = ()
) -> list[Design]:
    """The designs that were named: of run folders all designs, of files the file; each once.

    Arguments:
        targets: Designs, design files and run folders.
        judge: The run in whose scenes they are scored, where one was named.
        notes: Called with every note.
        names: The designs that are wanted; where a run has all of them, its others are not read.

    Raises:
        DataError: One is not there, or there are none.
    """
    designs: list[Design] = []
    paths = [target for target in targets if isinstance(target, Path)]
    opened = {path: RunFolder.open(path) for path in paths if path.is_dir()}
    runs = [judge] if judge else list(opened.values())
    reach_m = reach_beside([path for path in paths if path.is_file()], runs)
    for target in targets:
        if isinstance(target, Design):
            designs.append(target)
        elif target in opened:
            run = opened[target]
            wanted = [path for path in run.design_paths() if path.stem in names]
            found = wanted if wanted and len(wanted) == len(set(names)) else run.design_paths()
            designs += [Design(read_design(path, notes), run, path) for path in found]
        elif not target.exists():
            raise DataError("no such run or design", where=str(target), hint="give run folders or design files")
        else:
            design = read_design(target, notes, reach_m)
            designs.append(Design(design, run_of(design, target), target))
    seen: dict[object, Design] = {}
    for design in designs:
        # they may be renamed: a user's own keep their names
        copy = Design(design.specification, design.run, design.path)
        seen.setdefault(id(design) if design.path is None else design.path.resolve(), copy)
    if not seen:
        where = str(runs[0].folder if judge else next(iter(opened)))
        raise DataError("the run has no designs yet", where=where, hint=f"lidardesign fit {pasted(where)}")
    return list(seen.values())


def select_by_name(designs: list[Design], names: Sequence[str]) -> list[Design]:
    """The designs of these names; all of them without names.

    Raises:
        ConfigError: There is no design of a name.
    """
    known = {design.name for design in designs}
    for name in names:
        if name not in known:
            raise ConfigError(f"no design {name!r}", where="--designs", allowed=", ".join(sorted(known)) or "none")
    return [design for design in designs if not names or design.name in names]


def name_apart(designs: list[Design]) -> list[Design]:
    """Make the names of designs distinct, by their run's folder in front or their file's suffix behind.

    Raises:
        ConfigError: Two names are still equal.
    """
    alike: dict[str, list[Design]] = {}
    for design in designs:
        alike.setdefault(design.name, []).append(design)
    for name, group in alike.items():
        # of their runs, or of their files
        places = [each.run.folder if each.run else each.path.parent if each.path else Path() for each in group]
        folders = [place.resolve().name for place in places]
        for design, folder in zip(group, folders, strict=True):
            # files of one folder, as rig.csv and rig.sdf, differ in their endings alone
            ending = design.path.suffix if design.path is not None and folders.count(folder) > 1 else ""
            front = f"{folder}/" if len(set(folders)) > 1 else ""
            if len(group) > 1:
                design.specification = replace(design.specification, name=f"{front}{name}{ending}")
    names = [design.name for design in designs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice:
        raise ConfigError(f"two designs are called {twice!r}", hint="rename one of the files")
    return designs


def scoring_run(designs: Sequence[Design], judge: RunFolder | None, notes: Notes = log_note) -> RunFolder:
    """The run in whose scenes designs are scored: the named one, else the one that they came from.

    Arguments:
        designs: The designs; of those from a run of other settings a note says whether they fit here.
        judge: The run that was named.
        notes: Called with every note.

    Raises:
        ConfigError: There is none, or runs differ and none was named.
    """
    candidates = [judge] if judge else [design.run for design in designs if design.run is not None]
    if not candidates:
        raise ConfigError(
            "no design comes from a run that can be found, so the task is unknown",
            hint="name the run whose scenes are used: --in RUN",
        )
    judge = candidates[0]
    other = next((run for run in candidates if _settings(run) != _settings(judge)), None)
    if other is not None:
        raise ConfigError(
            f"{judge.folder} and {other.folder} differ in task, configuration or design space",
            hint="name the run whose scenes are used: --in RUN",
        )
    for design in designs:
        condition = design.specification.condition
        if condition is not None and condition not in judge.config.space.condition:
            raise ConfigError(
                f"its rays follow {condition}, which the task {judge.task.name} does not have as a condition",
                where=f"design {design.name}",
                hint="fit a design at one value: lidardesign fit RUN --at",
            )
        if design.run is not None and _settings(design.run) != _settings(judge):
            outside = outside_space(design.specification, judge.config.space)
            there = f"; {outside} its design space" if outside else ""
            moved = ", ".join(moved_files(design.run.config.task, judge.config.task))
            there += f"; held out in one of these runs and learned from in the other: {moved}" if moved else ""
            notes(f"{design.name} of {design.run.folder} is scored in the scenes of {judge.folder}{there}")
    return judge


def _settings(run: RunFolder) -> tuple[Any, ...]:
    """A key that is equal for runs whose designs can be scored in the same scenes."""
    return run.config.task_name, scoring_settings(run.task, run.config.task), run.config.space


def html_table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A small table for notebooks; every text is escaped."""

    def line(cells: Sequence[object], kind: str) -> str:
        return "<tr>" + "".join(f"<{kind}>{html.escape(str(cell))}</{kind}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    head = f"<thead>{line(headings, 'th')}</thead>" if headings else ""
    return f"<table><caption>{html.escape(caption)}</caption>{head}<tbody>{body}</tbody></table>"
