"""`lidardesign fit` and `constrain`: sensors for the density of a run, free or under constraints; neither trains."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lidardesign.cli.terminal import options
from lidardesign.cli.terminal.design_tables import show_fit
from lidardesign.cli.terminal.grids import RichConsole
from lidardesign.cli.terminal.options import constraint_keys
from lidardesign.cli.terminal.output import Output, command, keep_times
from lidardesign.errors import LidardesignError
from lidardesign.run.clock import WAIT_S, phase
from lidardesign.run.files import check_lock
from lidardesign.run.outputs import check_writable

if TYPE_CHECKING:
    from lidardesign.fitting.request import FitRequest


def fit(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder that `learn` made.")],
    sensors: options.Sensors = None,
    layout: options.Layout = None,
    rays: options.RayCount = None,
    channels: options.Channels = None,
    gates: options.Gates = None,
    level: options.Level = None,
    at: options.At = None,
    weights: options.Weights = None,
    parts: options.Parts = None,
    modules: options.Modules = None,
    fov: options.ModuleField = None,
    zones: options.ModuleZones = None,
    like: options.Like = None,
    name: options.Name = "fit",
    seed: options.Seed = None,
    certify: options.Certify = False,
    detector: options.Judge = None,
    overrides: options.SceneSettings = None,
    survive: options.Survive = None,
    goal: options.Goal = None,
    least: options.Least = None,
    adaptive: options.Adaptive = None,
    workers: options.Workers = "1",
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Fit sensors to the density of RUN."""
    with command(json=json, quiet=quiet, verbose=verbose) as output:
        with phase("libraries"):
            from lidardesign.fitting.options import FitOptions
            from lidardesign.fitting.request import FitRequest
            from lidardesign.run_folder import RunFolder

        names, count = options.part_names(parts, modules, fov, zones, sensors)
        chosen = FitOptions(
            sensors=count,
            layout=layout,
            rays=rays,
            channels=channels,
            gates=gates,
            level=level,
            at=options.parse_at(at),
            weights=weights or (),
            parts=names,
            like=like,
            name=name,
            seed=seed,
            certify=certify,
            detector=detector,
            settings=overrides or (),
            survive=survive,
            goal=goal,
            least=least,
            adaptive=adaptive,
        )
        run_fit(FitRequest.resolve(RunFolder.open(run), chosen, notes=output.remark), output, workers)


def run_fit(request: FitRequest, output: Output, workers: str) -> None:
    """Fit the design of a request, save it, and give the result."""
    from lidardesign.api.design import Design
    from lidardesign.sensors.design_file import design_text

    path = request.run.design_path(request.name)
    label = "design (replaced)" if path.exists() else "design"
    check_writable(path)
    check_lock(request.run.folder)
    with output.progress("fitting") as progress:
        shown = lambda step, *_: progress.show(label=step)  # noqa: E731
        design = Design.fitted(request, workers=workers, notes=output.remark, progress=shown)
    try:
        design.save()
    except LidardesignError:
        output.keep(design_text(design.specification, Path(design.name)), ".yaml")
        raise
    document = design.as_dict()
    keep_times(request.run.folder, request.command, output, wait_s=WAIT_S, created=request.run.created)

    def show(rich: RichConsole) -> None:
        checks = design.result.constraints if design.result else ()
        show_fit(document, design.specification, checks, rich, verbose=output.verbose)

    output.result(document, show, files={label: Path(document["design"])})


def constrain(
    target: Annotated[
        Path, typer.Argument(metavar="RUN|DESIGN", readable=False, help="A run folder, or a design that came from one.")
    ],
    constraints: Annotated[
        Path | None,
        typer.Option(
            "--constraints", metavar="FILE", help="YAML file (config schema constraints).", show_default=False
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="One constraint: gate.width_m.max=0.1, or a key of the task as for `fit`; repeatable.",
            show_default=False,
            autocompletion=constraint_keys,
        ),
    ] = None,
    sensors: options.Sensors = None,
    layout: options.Layout = None,
    rays: options.RayCount = None,
    channels: options.Channels = None,
    gates: options.Gates = None,
    level: options.Level = None,
    at: options.At = None,
    weights: options.Weights = None,
    parts: options.Parts = None,
    modules: options.Modules = None,
    fov: options.ModuleField = None,
    zones: options.ModuleZones = None,
    like: options.Like = None,
    name: options.Name = "constrained",
    seed: options.Seed = None,
    certify: options.Certify = False,
    detector: options.Judge = None,
    survive: options.Survive = None,
    goal: options.Goal = None,
    least: options.Least = None,
    adaptive: options.Adaptive = None,
    workers: options.Workers = "1",
    json: options.Json = False,
    quiet: options.Quiet = False,
    verbose: options.Verbose = False,
) -> None:
    """Fit sensors again under constraints; nothing is learned again."""
    with command(json=json, quiet=quiet, verbose=verbose) as output:
        with phase("libraries"):
            from lidardesign.constraints.document import Constraints, load_constraints, split_settings
            from lidardesign.fitting.options import FitOptions
            from lidardesign.fitting.request import FitRequest
            from lidardesign.formats.designs import need_run, open_target

        opened, design = open_target(target, output.remark)
        run = need_run(opened, target)
        bounds, settings = split_settings(overrides or (), run.task)
        names, count = options.part_names(parts, modules, fov, zones, sensors)
        chosen = FitOptions(
            sensors=count,
            constraints=load_constraints(constraints, bounds, output.remark) or Constraints(),
            layout=layout,
            rays=rays,
            channels=channels,
            gates=gates,
            level=level,
            at=options.parse_at(at),
            weights=weights or (),
            parts=names,
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
        run_fit(FitRequest.resolve(run, chosen, design, notes=output.remark), output, workers)
