"""Designs as users hold them: a specification, the run and the file that it belongs to, and what its fit found."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidardesign.design.files import design_text, save_design
from lidardesign.design.fit import FitResult
from lidardesign.design.layouts.rays import certificates_of
from lidardesign.design.sensor import CERTIFICATES, DesignSpec
from lidardesign.geometry.rays import Rays
from lidardesign.run.clock import WAIT_S, phase
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import write_recorded
from lidardesign.workflow.export import (
    DesignSource,
    Exported,
    ExportRequest,
    check_frame_rate,
    export_target,
    exporter_of,
)
from lidardesign.workflow.fit import FitOptions, FitRequest
from lidardesign.workflow.fit_design import fit_design
from lidardesign.workflow.run_folder import Notes, RunFolder, log_note, need_run, relative_folder

if TYPE_CHECKING:
    from lidardesign.evaluate.report.figures import Figure


class Design(DesignSource):
    """A LiDAR design: sensors with their layout, the run that it was fitted in, and what the fit found.

    `run.fit(...)` and `load_design(path)` give designs. Lengths are metres, angles radians.

    Arguments:
        specification: Sensors, layout, number of rays, constraints and where they came from.
        run: The run that it was fitted in; None for a rig of others, or where the run has gone.
        path: Its file; None while it was not saved.
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
    def fitted(cls, request: FitRequest, *, notes: Notes = log_note) -> Design:
        """The design that a request comes to; it is not saved yet."""
        result = fit_design(request, notes=notes)
        return cls(result.design, request.run, None, result)

    @property
    def name(self) -> str:
        """Its name, which is its file's and its rows'."""
        return self.specification.name

    def constrain(self, *, notes: Notes = log_note, **options: Any) -> Design:
        """Fit again in its run; what is not chosen anew stays as it is.

        Arguments:
            notes: Called with every note.
            options: As of `FitOptions`: constraints, sensors, rays, layout, gates, level, at, name and more.

        Raises:
            DataError: The run has gone.
            InfeasibleError: Constraints that contradict each other, or hold too little of the density.
        """
        run = need_run(self.run, self.name if self.path is None else self.path)
        request = FitRequest.resolve(run, FitOptions(**options), self.specification, notes=notes)
        return Design.fitted(request, notes=notes)

    def rays(
        self, count: int | None = None, *, at: Mapping[str, float] | None = None, seed: int = 0, notes: Notes = log_note
    ) -> Rays:
        """The explicit rays that it fires: origins, directions and gates, by ray.

        Arguments:
            count: How many; its own by default, or the largest number of its task.
            at: Values of conditions, as {"x_m": 0.37}.
            seed: Root of the random streams.
            notes: Called with every note.
        """
        return self.lay_out(count, at, seed, notes=notes)[1]

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
            with run_lock(run.folder, wait_s=WAIT_S):
                write_recorded(run.folder, self.path.relative_to(run.folder).as_posix(), content)
            return self.path
        path, origin = Path(path), dict(self.specification.provenance)
        if self.run is not None and "run" in origin:
            origin["run"] = relative_folder(self.run.folder, path)
        self.specification = replace(self.specification, provenance=origin)
        save_design(self.specification, path)
        self.path = path
        return path

    def export(
        self,
        path: Path | str | None = None,
        format: str | None = None,
        *,
        rays: int | None = None,
        at: Mapping[str, float] | None = None,
        rate_hz: float | None = None,
        seed: int = 0,
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
            seed: Root of the random streams.
            robot: A robot's MuJoCo model that the sensors are put into (mjcf).
            notes: Called with every note.
        """
        check_frame_rate(rate_hz)
        out = None if path is None else Path(path)
        exporter = exporter_of(format, out)
        target = export_target(self.path, out, exporter)
        return ExportRequest(self, exporter, target, rays, at or {}, rate_hz, seed, robot).write(notes=notes)

    def figure(self, count: int | None = None) -> Figure:
        """Its sensors in space, with fields of view and gates; with a number of rays these, too (plotly)."""
        from lidardesign.evaluate.report.figures import design_figure

        return design_figure(self.specification, None if count is None else self.rays(count))

    def as_dict(self) -> dict[str, Any]:
        """What `lidardesign fit --json` prints of it: sensors, and what the fit found."""
        place = self.name if self.path is None else str(self.path)
        certificates = certificates_of(self.specification)
        further = {CERTIFICATES: certificates} if certificates else {}
        if self.result is None:
            return {"design": place, "sensors": [sensor.as_dict() for sensor in self.specification.sensors]}
        return {**self.result.as_dict(), "design": place, **further}

    def __repr__(self) -> str:
        spec = self.specification
        rays = "rays left open" if spec.rays is None else f"{spec.rays} rays"
        return f"<Design {self.name}: {len(spec.sensors)} sensors, layout {spec.layout}, {rays}>"

    def _repr_html_(self) -> str:
        headings = ("sensor", "weight", "origin [m]", "azimuth [rad]", "elevation [rad]", "gate [m]")
        rows = [
            (
                sensor.name,
                f"{sensor.weight:.3f}",
                " ".join(f"{value:.3f}" for value in sensor.origin_m),
                f"{sensor.azimuth_rad:.3f}",
                f"{sensor.elevation_rad:.3f}",
                " - ".join(f"{value:.3f}" for value in sensor.gate_m),
            )
            for sensor in self.specification.sensors
        ]
        return html_table(repr(self)[1:-1], headings, rows)


def html_table(caption: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A small table for notebooks; every text is escaped."""

    def line(cells: Sequence[object], kind: str) -> str:
        return "<tr>" + "".join(f"<{kind}>{html.escape(str(cell))}</{kind}>" for cell in cells) + "</tr>"

    body = "".join(line(row, "td") for row in rows)
    head = f"<thead>{line(headings, 'th')}</thead>" if headings else ""
    return f"<table><caption>{html.escape(caption)}</caption>{head}<tbody>{body}</tbody></table>"
