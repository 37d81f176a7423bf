"""`lidardesign fit`: fit sensors to a learned density."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.dry_run import DryRun, tell_plan
from lidardesign.cli.output import Output, command, keep_times
from lidardesign.errors import ConfigError
from lidardesign.run.clock import WAIT_S, phase
from lidardesign.workflow.rig_constraints import likeness
from lidardesign.workflow.runs import check_choice, check_name, open_run, parse_at, provenance, sensor_count
from lidardesign.workflow.weighting import Weighting

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.design.constraints.check import ConstraintCheck
    from lidardesign.design.constraints.document import Constraints
    from lidardesign.design.fit import FitResult
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.space import DesignSpace
    from lidardesign.workflow.runs import Run

LAYOUTS = ("grid", "density", "scan", "distributed")
GATES = ("sensor", "ray")


def fit(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder that `learn` made.")],
    sensors: options.Sensors = None,
    layout: options.Layout = None,
    rays: options.RayCount = None,
    gates: options.Gates = None,
    level: options.Level = None,
    at: options.At = None,
    weights: options.Weights = None,
    refine: options.Refine = None,
    like: options.Like = None,
    name: options.Name = "fit",
    dry_run: DryRun = False,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Fit sensors to the density of RUN."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        check_name(name)
        load_libraries()
        check_choices(gates, layout)
        count, condition = sensor_count(sensors, None), parse_at(at)
        opened = open_run(run)
        constraints, layout, names = likeness(like, None, layout, rays, opened, console)
        layout = layout or usual_layout(opened)
        check_sensors(count, layout)
        rays = rays or (constraints.budget.rays if constraints else None)
        usual = constraints.sensors.count if constraints else opened.task.defaults.sensors
        open_budget = layout == "grid" and gates != "ray"
        budget = rays if rays is not None or open_budget else max(opened.task.defaults.rays)
        fit_and_write(
            opened,
            console,
            command_name="fit",
            name=name,
            seed=opened.config.seed if seed is None else seed,
            constraints=constraints,
            names=names,
            sensors=usual if count is None else count,
            layout=layout,
            rays=budget,
            gates=gates,
            level=check_level(opened.task.defaults.level if level is None else level),
            at=condition,
            weighting=Weighting(tuple(weights or ())),
            refine=refine,
            plan_of=(like,) if dry_run else None,
        )


def check_choices(gates: str | None, layout: str | None) -> None:
    """Refuse gates and layouts that there are none of.

    Raises:
        ConfigError: See above.
    """
    if layout is not None:
        check_choice(layout, "--layout", LAYOUTS)
    if gates is not None:
        check_choice(gates, "--gates", GATES)


@phase("libraries")
def load_libraries() -> None:
    """Import what every fit needs, so that no other phase seems to take that long."""


def check_level(level: float) -> float:
    """A share that intervals can hold.

    Raises:
        ConfigError: It is next to nothing, or next to everything.
    """
    from lidardesign.design.sensor import LEVELS

    if not LEVELS[0] <= level <= LEVELS[1]:
        raise ConfigError(f"{level:g}", where="--level", allowed=f"{LEVELS[0]:g} to {LEVELS[1]:g}")
    return level


def check_sensors(count: int | str | None, layout: str) -> None:
    """Refuse a number of sensors where the rays say how many there are.

    Raises:
        ConfigError: A scan was asked for with a number of sensors.
    """
    if count is not None and layout == "scan":
        raise ConfigError(
            f"{count} sensors of a scan, whose every ray is a sensor of its own",
            where="--sensors",
            hint="give --rays N alone, or another --layout",
        )


def usual_layout(run: Run) -> str:
    """The layout that a run's task suggests.

    Raises:
        ConfigError: It is none.
    """
    return check_choice(run.task.defaults.layout, f"defaults.layout of task {run.task.name}", LAYOUTS)


def fit_and_write(
    run: Run,
    console: Output,
    *,
    command_name: str,
    name: str,
    seed: int,
    constraints: Constraints | None = None,
    names: Sequence[str] = (),
    at: Mapping[str, float] | None = None,
    weighting: Weighting,
    refine: int | None = None,
    plan_of: Sequence[Path | None] | None = None,
    **choices: Any,
) -> None:
    """Fit a design to a run's samples, refine it if asked to, write it, and give the result.

    Arguments:
        run: An opened run.
        console: Where the result goes.
        command_name: For the design's provenance.
        name: The design's name and its file's.
        seed: Root of the random streams.
        constraints: Checked constraints, or None.
        names: What sensors are called, where there are as many; none numbers them.
        at: Condition values that the design is for; without any, one for all of them.
        weighting: What the density is multiplied by.
        refine: Rounds of refinement, or None.
        plan_of: Where only the plan is wanted, the files that were read for it.
        choices: sensors, layout, rays, gates and level, as `lidardesign.design.fit.fit` takes them.
    """
    if plan_of is not None:
        from lidardesign.cli.dry_run import fit_plan

        run.config.space.at(at or {})
        given = {"constraints": constraints, "at": at or {}, "weighting": weighting, "refine": refine}
        return tell_plan(fit_plan(run, command_name, name, plan_of, seed=seed, choices=choices, **given), console)

    from lidardesign.cli.tables.designs import write_design
    from lidardesign.workflow.refine import FitOrder, fitted, refined
    from lidardesign.workflow.weighting import KEY

    path = run.design_path(name)
    order = FitOrder(run, name, seed, constraints, at or {}, choices)
    if refine is None:
        (result, weighting), further = fitted(order, weighting, console), {}
    else:
        (result, weighting), further = refined(order, weighting, refine, console)
    for note in result.notes:
        console.note(f"note: {note}")
    made_by = provenance(run, path, command_name, seed, **({KEY: weighting.as_document()} if weighting else {}))
    result, design = _finished(result, names, made_by)
    with phase("writing"):
        checks = check_written(design, constraints, run.config.space)
        write_design(design, run.folder, path)
    document = {**_document(result, path, checks), **further}
    keep_times(run.folder, command_name, console, wait_s=WAIT_S)
    console.result(document, lambda rich: _show(document, design, checks, rich))


def _show(document: dict[str, Any], design: DesignSpec, checks: Sequence[ConstraintCheck], rich: RichConsole) -> None:
    """Print what was fitted, after the rounds of its refinement."""
    from lidardesign.cli.tables.designs import show_fit
    from lidardesign.workflow.refine import show_refinement

    show_refinement(document, rich)
    show_fit(document, design, checks, rich)


def _finished(result: FitResult, names: Sequence[str], made_by: Mapping[str, Any]) -> tuple[FitResult, DesignSpec]:
    """The result with sensors of these names, if they are as many, and its design with where it came from."""
    design = result.design
    if len(names) == len(design.sensors):
        named = (replace(sensor, name=name) for sensor, name in zip(design.sensors, names, strict=True))
        design = replace(design, sensors=tuple(named))
    return replace(result, design=design), replace(design, provenance={**design.provenance, **made_by})


def _document(result: FitResult, path: Path, checks: Sequence[ConstraintCheck]) -> dict[str, Any]:
    """The JSON form of a fit whose design was written and checked."""
    return {
        **result.as_dict(),
        "design": str(path),
        "constraints": [_check_dict(check) for check in checks],
        "satisfied": all(check.satisfied for check in checks),
    }


def check_written(design: DesignSpec, constraints: Constraints | None, space: DesignSpace) -> list[ConstraintCheck]:
    """Check a design's own text against its constraints with code that the fit does not share.

    Raises:
        InfeasibleError: A constraint does not hold; nothing was written.
    """
    if constraints is None:
        return []
    from lidardesign.design.constraints.check import check_design
    from lidardesign.design.files import design_document
    from lidardesign.run.yaml import dump_yaml, parse_yaml

    written = parse_yaml(dump_yaml(design_document(design)), where=design.name).value
    return refuse_broken(list(check_design(written, constraints, space)))


def refuse_broken(checks: list[ConstraintCheck]) -> list[ConstraintCheck]:
    """The checks of a design that keeps its constraints.

    Raises:
        InfeasibleError: One does not hold.
    """
    from lidardesign.errors import InfeasibleError

    broken = [check for check in checks if not check.satisfied]
    if broken:
        first = broken[0]
        raise InfeasibleError(
            f"the best design found breaks {first.name}: {first.value}, bound {first.bound}",
            conflicts=[check.name for check in broken],
            hint="loosen one of the constraints; no file was written",
        )
    return checks


def _check_dict(check: Any) -> dict[str, Any]:
    return {"name": check.name, "bound": check.bound, "value": check.value, "satisfied": check.satisfied}
