"""`lidardesign compare`: two designs beside each other, sensor by sensor and scene by scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.cli import options
from lidardesign.cli.commands.show import SpaceOf
from lidardesign.cli.output import command
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase

if TYPE_CHECKING:
    from rich.console import Console as RichConsole

    from lidardesign.cli.output import Output
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.evaluate.score import Evaluation, EvaluationRequest
    from lidardesign.workflow.designs import Design
    from lidardesign.workflow.run_folder import RunFolder

RayCounts = Annotated[
    list[int] | None,
    typer.Option(
        "--rays",
        metavar="N",
        min=1,
        max=1_000_000,
        help="Rays per frame at which scores are compared; repeatable.",
        show_default="both as they are, else the task's",
    ),
]
SHOWN_DECIMALS = 6
SCORE_COLUMNS = ("design", "rays", "value", "95 % interval", "failures", "Mbit/s")
SENSOR_COLUMNS = (
    "first", "second", "place [m]", "looks [deg]", "field of view [deg]", "gate start [m]", "gate end [m]", "weight",
)  # fmt: skip


def compare(
    first: Annotated[
        Path, typer.Argument(metavar="DESIGN", readable=False, help="A design file, or the file of a rig.")
    ],
    second: Annotated[Path, typer.Argument(metavar="OTHER", readable=False, help="The design to compare it with.")],
    space_of: SpaceOf = None,
    rays: RayCounts = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
    debug: options.Debug = False,
) -> None:
    """Compare two designs: what differs in their sensors, and in their scores on held-out scenes of a run."""
    with command(json=json, quiet=quiet, debug=debug) as console:
        with phase("libraries"):
            import lidardesign.design.layouts.rays  # noqa: F401
            from lidardesign.design.compare import paired_sensors, readout_of

        entries, run = _read(first, second, space_of, console)
        designs = [entry.specification for entry in entries]
        if run is None and rays:
            raise ConfigError("no run says what the designs see", where="--rays", hint="--in RUN")
        document: dict[str, Any] = {
            "designs": [
                {
                    "design": str(entry.path),
                    "name": entry.specification.name,
                    "layout": entry.specification.layout,
                    "sensors": len(entry.specification.sensors),
                    "bandwidth": readout_of(entry.specification).as_dict(),
                }
                for entry in entries
            ],
            "sensors": [pair.as_dict() for pair in paired_sensors(*designs)],
            **(_scores(run, entries, rays, seed, console) if run else _NO_SCORES),
        }
        console.result(document, lambda rich: _show(document, rich))


_NO_SCORES: dict[str, Any] = {"metric": None, "scenes": None, "rows": [], "paired": []}


@phase("designs")
def _read(first: Path, second: Path, space_of: Path | None, console: Output) -> tuple[list[Design], RunFolder | None]:
    """Both designs under names that differ, and the run whose scenes they are scored in, if one is known."""
    from lidardesign.workflow.designs import Design
    from lidardesign.workflow.evaluate import common_run
    from lidardesign.workflow.run_folder import RunFolder, reach_beside, read_design, run_of

    given = [RunFolder.open(space_of)] if space_of is not None else []
    entries = []
    reach_m = reach_beside((first, second), given)
    for path in (first, second):
        design = read_design(path, console.remark, reach_m)
        entries.append(Design(design, run_of(design, path), path))
    if entries[0].specification.name == entries[1].specification.name:
        for entry, place in zip(entries, ("first", "second"), strict=True):
            entry.specification = replace(entry.specification, name=f"{entry.specification.name} ({place})")
    if not given and all(entry.run is None for entry in entries):
        console.note("note: no run says what the designs see, so there are no scores; --in RUN has scenes")
        return entries, None
    return entries, common_run(entries, given)


def _scores(
    run: RunFolder, entries: Sequence[Design], rays: list[int] | None, seed: int | None, console: Output
) -> dict[str, Any]:
    """Scores on held-out scenes and their paired differences, first minus second."""
    from lidardesign.workflow.evaluate import evaluation_request

    with phase("libraries"):
        from lidardesign.design.compare import outside_notes
        from lidardesign.evaluate.score import evaluate

    own = [_own_count(entry.specification) for entry in entries]
    counts = rays or _counts([entry.specification for entry in entries], own, run, console)
    _check_fired([entry.specification for entry in entries], counts, console)
    request = replace(evaluation_request(run, entries, counts, [], seed), equal_bandwidth=False)
    for entry in entries:
        for line in outside_notes(entry.specification, run.config.space):
            console.note(f"note: {line}")
    found = evaluate(request)
    rows, paired = [row.as_dict() for row in found.rows], [pair.as_dict() for pair in found.paired]
    if not rays and None not in own and own[0] != own[1]:
        further, difference = _as_they_are(request, [int(count or 0) for count in own])
        rows = [*further, *(row for row in rows if (row["design"], row["rays"]) not in _keys(further))]
        paired = [difference, *paired]
    metric = found.metric
    return {
        "metric": {"name": metric.name, "unit": metric.unit, "better": metric.better, "worst": metric.worst},
        "scenes": found.scenes,
        "rows": rows,
        "paired": paired,
    }


def _check_fired(designs: Sequence[DesignSpec], counts: Sequence[int], console: Output) -> None:
    """Say where a design has no row; a design that has none at all is refused."""
    from lidardesign.evaluate.request import fired_numbers, left_out

    for design in designs:
        fired_numbers([design], counts)
    for line in left_out(designs, counts):
        console.note(f"note: {line}")


def _keys(rows: Sequence[dict[str, Any]]) -> set[tuple[str, int]]:
    return {(row["design"], row["rays"]) for row in rows}


def _own_count(design: DesignSpec) -> int | None:
    """The number of rays that a design was made for; None where it leaves it open."""
    from lidardesign.design.compare import readout_of

    return readout_of(design).rays


def _counts(designs: Sequence[DesignSpec], own: Sequence[int | None], run: RunFolder, console: Output) -> list[int]:
    """Rays at which two designs are compared: what both were made for, else the budgets that both have.

    Where a rig has fewer rays than the task's largest budget, its own number takes the place of those beyond it.
    """
    from lidardesign.design.layouts.rays import layout_of

    if own[0] is not None and own[0] == own[1]:
        return [own[0]]
    sizes = {design.name: layout_of(design).most_count(design) for design in designs}
    fixed = {name: size for name, size in sizes.items() if size is not None}
    usual = sorted(set(run.task.defaults.rays))
    if not fixed or min(fixed.values()) >= usual[-1]:
        return usual
    name = min(fixed, key=lambda name: fixed[name])
    console.remark(f"{name} fires {fixed[name]} rays: at equal rays no more are compared; --rays has other numbers")
    return sorted({*(count for count in usual if count <= fixed[name]), fixed[name]})


def _as_they_are(request: EvaluationRequest, own: Sequence[int]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Both designs with the rays that each was made for, and their difference in the same scenes."""
    from lidardesign.evaluate.results import Paired
    from lidardesign.evaluate.score import evaluate
    from lidardesign.evaluate.statistics import paired_difference

    found: list[Evaluation] = [
        evaluate(replace(request, designs=[design], rays=[count]))
        for design, count in zip(request.designs, own, strict=True)
    ]
    one, other = (evaluation.rows[0] for evaluation in found)
    difference = paired_difference(one.per_scene, other.per_scene, request.seed)
    pair = Paired(one.design, other.design, one.rays, *difference, rays_b=other.rays)
    return [one.as_dict(), other.as_dict()], pair.as_dict()


def _show(document: dict[str, Any], rich: RichConsole) -> None:
    from rich.markup import escape

    from lidardesign.cli.tables.designs import number
    from lidardesign.cli.tables.grids import print_table

    for place, design in zip(("first", "second"), document["designs"], strict=True):
        sensors = "1 sensor" if design["sensors"] == 1 else f"{design['sensors']} sensors"
        cost = design["bandwidth"]
        rays = "rays left open" if cost["rays"] is None else f"{cost['rays']} rays, {number(cost['high_mbps'])} Mbit/s"
        rich.print(escape(f"{place}: {design['name']}, {sensors}, layout {design['layout']}, {rays}"), soft_wrap=True)
    lines = [_sensor_line(pair) for pair in document["sensors"]]
    print_table("sensors: second minus first", SENSOR_COLUMNS, lines, rich, text=SENSOR_COLUMNS[:2])
    metric = document["metric"]
    if metric is None:
        return
    title = f"{metric['name']} [{metric['unit']}], {metric['better']} is better"
    title += f", over {document['scenes']} held-out scenes"
    rows = [
        [
            row["design"],
            *(number(row[name]) for name in ("rays", "value")),
            f"{number(row['ci_low'])} - {number(row['ci_high'])}",
            *(number(row[name]) for name in ("failures", "bandwidth_mbps")),
        ]
        for row in document["rows"]
    ]
    print_table(escape(title), SCORE_COLUMNS, rows, rich)
    for pair in document["paired"]:
        rich.print(escape(_verdict(pair, metric)), soft_wrap=True)


def _sensor_line(pair: dict[str, Any]) -> list[str]:
    from lidardesign.cli.tables.designs import number

    found = pair["difference"]
    names = [pair["a"] or "-", pair["b"] or "-"]
    if found is None:
        return [*names, *("-" for _ in SENSOR_COLUMNS[2:])]
    fields = f"{_signed(found['horizontal_deg'])} x {_signed(found['vertical_deg'])}"
    # what rounding leaves of no difference is none
    apart = [number(round(found[name], SHOWN_DECIMALS), 3) for name in ("place_m", "boresight_deg")]
    return [*names, *apart, fields, *(_signed(found[name], 3) for name in ("gate_start_m", "gate_end_m", "weight"))]


def _signed(value: float, decimals: int = 2) -> str:
    return f"{round(value, decimals) + 0.0:+.{decimals}f}"


def _verdict(pair: dict[str, Any], metric: dict[str, Any]) -> str:
    """Which of two is better in the scenes that both met, and how surely."""
    from lidardesign.cli.tables.designs import number

    rays = f"{pair['rays']}" if pair.get("rays_b") in (None, pair["rays"]) else f"{pair['rays']} and {pair['rays_b']}"
    low, high, unit = pair["ci_low"], pair["ci_high"], metric["unit"]
    span = f"{pair['a']} minus {pair['b']}: {number(pair['difference'], 3)} {unit}, 95 % interval {number(low, 3)} to "
    span += f"{number(high, 3)}, with {rays} rays"
    if low <= 0 <= high:
        return f"{span}: no difference is shown"
    lower = pair["a"] if pair["difference"] < 0 else pair["b"]
    higher = pair["b"] if lower == pair["a"] else pair["a"]
    return f"{span}: {lower if metric['better'] == 'lower' else higher} is better"
