"""`lidardesign constrain`: fit again under constraints; never trains and needs no torch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.commands.fit import (
    check_choices,
    check_level,
    check_sensors,
    fit_and_write,
    load_libraries,
    usual_layout,
)
from lidardesign.cli.dry_run import DryRun
from lidardesign.cli.output import command
from lidardesign.workflow.rig_constraints import likeness
from lidardesign.workflow.runs import check_name, need_run, open_target, parse_at, sensor_count
from lidardesign.workflow.weighting import Weighting

if TYPE_CHECKING:
    from lidardesign.cli.output import Output
    from lidardesign.design.constraints.document import Constraints
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.run.yaml import KeyPath
    from lidardesign.workflow.runs import Run


Target = Annotated[
    Path, typer.Argument(metavar="RUN|DESIGN", readable=False, help="A run folder, or a design that came from one.")
]


def constrain(
    target: Target,
    constraints: Annotated[
        Path | None,
        typer.Option("--constraints", metavar="FILE", help="YAML file; keys: docs/constraints.md.", show_default=False),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="One constraint: gate.width_m.max=0.1; repeatable.", show_default=False
        ),
    ] = None,
    sensors: options.Sensors = None,
    layout: options.Layout = None,
    rays: options.RayCount = None,
    gates: options.Gates = None,
    level: options.Level = None,
    at: options.At = None,
    weights: options.Weights = None,
    refine: options.Refine = None,
    like: options.Like = None,
    name: options.Name = "constrained",
    dry_run: DryRun = False,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Fit sensors again under constraints: seconds, nothing is learned again."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        check_name(name)
        load_libraries()
        check_choices(gates, layout)
        count, condition = sensor_count(sensors, None), parse_at(at)
        asked = load_constraints(constraints, overrides or [], console)
        check_parts(asked)
        opened, design = open_target(target, console)
        run = need_run(opened, target)
        checked, layout, names = likeness(like, asked, layout, rays, run, console)
        layout = layout or _usual(checked, design, run)
        check_sensors(count, layout)
        fit_and_write(
            run,
            console,
            command_name="constrain",
            name=name,
            seed=run.config.seed if seed is None else seed,
            constraints=checked,
            names=names,
            sensors=_sensors(count, checked, design, run.task.defaults.sensors),
            layout=layout,
            rays=_rays(rays, checked, design, layout == "grid" and gates != "ray", run.task.defaults.rays),
            gates=gates,
            level=check_level(_level(level, design, run.task.defaults.level)),
            at={**(design.at if design else {}), **condition},
            weighting=_weighting(weights, design, console),
            refine=refine,
            plan_of=(target if design else None, constraints, like) if dry_run else None,
        )


def _usual(constraints: Constraints, design: DesignSpec | None, run: Run) -> str:
    """The layout where none is named: the design's, else the task's; sensors that become parts are fitted as grids."""
    from lidardesign.design.sensor import fitted_layout
    from lidardesign.design.snap.parts import wants_parts

    if wants_parts(constraints.rules):
        return "grid"
    return fitted_layout(design.layout) if design else usual_layout(run)


def _weighting(given: list[str] | None, design: DesignSpec | None, console: Output) -> Weighting:
    """How samples are weighted: by the options, else as they were for the design."""
    own = Weighting.of(design) if design else Weighting()
    if not given:
        return own
    if own.reweighting is not None:
        console.note("note: with --weight the design's refinement is left out; --refine finds another")
    return Weighting(tuple(given))


def _level(given: float | None, design: DesignSpec | None, usual: float) -> float:
    """The level of intervals: the option's, else the design's, else the task's."""
    if given is not None:
        return given
    return design.level if design else usual


def check_parts(constraints: Constraints) -> None:
    """Refuse names of parts that there are none of before anything is fitted.

    Raises:
        ConfigError: So it is.
    """
    from lidardesign.design.snap.parts import parts_of

    for rules in constraints.rules:
        if rules.snap is not None and rules.snap.parts is not None:
            parts_of(rules.snap)


def load_constraints(file: Path | None, overrides: list[str], console: Output | None = None) -> Constraints:
    """Constraints of a file with `--set` laid over it; the console is told where the file holds none.

    Raises:
        ConfigError: At file:line:column, or at the `--set` option.
    """
    from lidardesign.config import apply_override, parse_override
    from lidardesign.design.constraints.document import CATALOG, Constraints
    from lidardesign.run.yaml import Document, leaves, load_yaml

    document = load_yaml(file) if file else Document({}, "constraints")
    values: dict[str, Any] = document.mapping
    if file and console is not None and all(value in (None, {}, []) for _, value in leaves(values)):
        console.note(f"note: {document.where} holds no constraints")
    origins: dict[KeyPath, str] = {}
    for text in overrides:
        override = parse_override(text)
        if len(override.path) > 1 and override.path[0] == "snap" and values.get("snap") == CATALOG:
            # the short form of a mapping without keys
            values["snap"] = {}
        origins[apply_override(values, override)] = override.where

    def locate(path: KeyPath, *, key: bool = False) -> str:
        path = tuple(path)
        for origin, where in origins.items():
            if path[: len(origin)] == origin or origin[: len(path)] == path != ():
                return where
        return document.locate(path, key=key)

    return Constraints.from_mapping(values, where=str(file) if file else "constraints", locate=locate)


def _sensors(given: Any, constraints: Constraints, design: DesignSpec | None, usual: int) -> Any:
    """The number of sensors: the option's, then what the constraints ask for, the design's, the task's."""
    from lidardesign.design.constraints.origins import is_mounted

    asked = constraints.sensors
    if given is not None or asked.count is not None:
        return given if given is not None else asked.count
    if is_mounted(constraints.rules):
        # the mounts say how many
        return None
    usual = max(len(design.sensors) if design else usual, len(constraints.each))
    return min(max(usual, asked.min or usual), asked.max or usual)


def _rays(
    given: int | None,
    constraints: Constraints,
    design: DesignSpec | None,
    may_stay_open: bool,
    budgets: tuple[int, ...],
) -> int | None:
    """The number of rays: the option's, then the constraints', the design's; a ray table needs one, parts have some."""
    from lidardesign.design.snap.parts import wants_parts

    if given is not None or wants_parts(constraints.rules):
        return given
    if constraints.budget.rays is not None:
        return constraints.budget.rays
    if design is not None and design.rays is not None:
        return design.rays
    return None if may_stay_open else max(budgets)
