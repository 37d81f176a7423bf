"""Designs as users hold them: a specification, the run and the file that it belongs to, and what its fit found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np

from lidardesign.api.export import (
    DesignSource,
    Exported,
    ExportRequest,
    export_target,
    format_of,
)
from lidardesign.api.problems import MethodRequest, problem_of
from lidardesign.choices.files import ExportChoices, SimulateChoices
from lidardesign.choices.flag import complete, takes
from lidardesign.errors import ConfigError, names_arguments
from lidardesign.fitting.options import DesignChoices
from lidardesign.fitting.request import FitRequest
from lidardesign.fitting.result import FitResult
from lidardesign.formats.designs import need_run, relative_folder
from lidardesign.rays.information import FEW_SCENES
from lidardesign.run.clock import WAIT_S, Progress, phase
from lidardesign.run.manifest import locked_run, write_recorded
from lidardesign.run.markup import counted, rendered
from lidardesign.run_folder import Notes, RunFolder, ignore, log_note, settings_texts
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_text, save_design
from lidardesign.workers import check_workers, opened_workers

if TYPE_CHECKING:
    from lidardesign.clouds.seen import SeenScene
    from lidardesign.report.figures import Figure


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
        request: FitRequest | MethodRequest,
        *,
        workers: int | str = 1,
        notes: Notes = log_note,
        progress: Progress | None = None,
    ) -> Design:
        """The design that a request comes to; it is not saved yet. `progress` is called with every step."""
        if isinstance(request, MethodRequest):
            return cls(request.design(), request.run)
        from lidardesign.fitting.fit import fit_design

        steps = ignore if progress is None else (lambda step: progress(step, None, None))
        with opened_workers(check_workers(str(workers)), request.run.task, FEW_SCENES) as starmap:
            result = fit_design(request, notes=notes, progress=steps, starmap=starmap)
        return cls(result.design, request.run, None, result)

    @property
    def name(self) -> str:
        """Its name: that of its file and of its rows."""
        return self.specification.name

    @takes(DesignChoices)
    def constrain(
        self, *, notes: Notes = log_note, progress: Progress | None = None, **choices: Unpack[DesignChoices]
    ) -> Design:
        """Fit it again in its run; what is not given stays as it is.

        Arguments:
            choices: Those of `DesignChoices`.
            notes: Called with every note.
            progress: Called with every step, as "choosing 361 rays", and twice None.

        Raises:
            DataError: The run has gone.
            InfeasibleError: Constraints that contradict each other, or hold too little of the density.
        """
        run = need_run(self.run, self.name if self.path is None else self.path)
        request = problem_of(run, choices, self.specification, notes=notes)
        return Design.fitted(request, workers=choices.get("workers", 1), notes=notes, progress=progress)

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

    @takes(ExportChoices)
    def export(
        self,
        path: Path | str | None = None,
        format: str | None = None,
        *,
        notes: Notes = log_note,
        **choices: Unpack[ExportChoices],
    ) -> Exported:
        """Write it for another program.

        Arguments:
            path: The file or folder; beside its own file by default.
            format: As `lidardesign export --list` shows them; by default what the path's ending says.
            choices: Those of `ExportChoices`.
            notes: Called with every note.
        """
        given, out = complete(ExportChoices, choices), None if path is None else Path(path)
        chosen = format_of(format, out)
        target = export_target(self.path, out, chosen.suffix)
        request = ExportRequest(self, chosen, target, given["rays"], given["at"], given["rate_hz"], given["robot"])
        return request.write(notes=notes)

    @takes(SimulateChoices)
    def simulate(
        self,
        scene: Path | str | Sequence[Scene] | None = None,
        *,
        notes: Notes = log_note,
        **choices: Unpack[SimulateChoices],
    ) -> list[SeenScene]:
        """What it sees in held-out scenes, with the effects that they call for, or in a mesh or robot of your own.

        Arguments:
            scene: A mesh file, a MuJoCo model in its initial configuration, or scenes of its run, as `run.scenes` gives
                them; None: held-out ones.
            choices: Those of `SimulateChoices`.
            notes: Called with every note.

        Raises:
            ConfigError: An unknown choice, or no run to take scenes from.
            DataError: The file of the scene cannot be read.
        """
        return self.seen(scene, choices, notes=notes)

    def seen(
        self, scene: Path | str | Sequence[Scene] | None, given: SimulateChoices, *, notes: Notes
    ) -> list[SeenScene]:
        """As `simulate`, with errors in terms of command-line options."""
        from lidardesign.clouds.seen import Measuring, scene_of_file, seen_in_file, seen_scenes

        choices = complete(SimulateChoices, given)
        rays, scenes, settings = choices["rays"], choices["scenes"], settings_texts(choices["settings"])
        measuring = Measuring(str(choices["detector"]), choices["seed"])
        count, spec = self.usual_count(notes) if rays is None else rays, self.specification
        if scene is None:
            run = need_run(self.run, self.name)
            for note in run.input_notes():
                notes(note)
            found = seen_scenes(run, spec, count, scenes, measuring, settings)
            if len(found) < scenes:
                notes(f"there are {len(found)} held-out scenes; --set test=N makes more, where the task has that key")
            return found
        if not isinstance(scene, Path | str):
            return seen_scenes(need_run(self.run, self.name), spec, count, scene, measuring, settings)
        if settings or scenes != 1 or spec.condition is not None:
            fault = "a design whose rays follow a condition" if spec.condition is not None else "--set or --scenes"
            raise ConfigError(f"{fault} together with a scene of your own", where="--scene", allowed="held-out scenes")
        if spec.following(count) is not None:
            notes("in a scene of your own the best single pattern fires")
        if measuring.seed is None and self.run is not None:
            measuring = replace(measuring, seed=self.run.config.seed)
        return [seen_in_file(scene_of_file(Path(scene), spec.mount, choices["scale"]), spec, count, measuring)]

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
        return f"<Design {self.name}: {counted(len(spec.sensors), 'sensor')}, layout {spec.layout}, {rays}>"

    def _repr_html_(self) -> str:
        spec = self.specification
        rows = [{**sensor.as_text(), "weight": f"{sensor.weight:.3f}"} for sensor in spec.sensors]
        return html_table(f"{repr(self)[1:-1]}, in {spec.frame}", list(rows[0]), [list(row.values()) for row in rows])


def html_table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A small table for notebooks."""
    return rendered("api/templates/table.html", caption=caption, headings=headings, rows=rows)
