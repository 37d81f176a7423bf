"""`lidardesign show`: a run or a design for people, or what differs between two designs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lidardesign.choices.files import ShowCommand
from lidardesign.choices.shared import Brief
from lidardesign.cli.terminal.design_tables import show_constraints, show_design
from lidardesign.cli.terminal.grids import RichConsole, difference_cell, duration, number, print_table, value_cells
from lidardesign.cli.terminal.options import command_line
from lidardesign.cli.terminal.output import Output
from lidardesign.errors import ConfigError, LidardesignError
from lidardesign.run.clock import phase
from lidardesign.run.markup import counted

if TYPE_CHECKING:
    from lidardesign.sensors.compare import BandwidthUse
    from lidardesign.sensors.design import DesignSpec

DESIGN_COLUMNS, VALUE_COLUMNS = ("design", "layout", "sensors", "rays"), ("value", "95 % interval", "difference")
IDEAL = "ideal"
# What rounding leaves of no difference is none.
DECIMALS = 6
SENSOR_COLUMNS = (
    "first", "second", "place [m]", "looks [deg]", "roll [deg]", "field of view [deg]", "gate start [m]",
    "gate end [m]", "weight",
)  # fmt: skip


@command_line(ShowCommand, Brief)
def show(
    output: Output,
    design: Annotated[
        Path,
        typer.Argument(metavar="RUN|DESIGN", readable=False, help="A run folder, a design file, or the file of a rig."),
    ],
    other: Annotated[
        Path | None,
        typer.Argument(
            metavar="OTHER", readable=False, help="Another design: show only what differs.", show_default=False
        ),
    ] = None,
    *,
    at: Sequence[str] = (),
    space_of: Path | None = None,
) -> None:
    """Show a run and what to do next, a design, or how two differ."""
    if design.is_dir() and other is None:
        return _show_run(design, {"--at": at, "--in": space_of}, output)
    with phase("libraries"):
        from lidardesign.constraints.check import check_design
        from lidardesign.constraints.slack import broken_notes, room_of
        from lidardesign.formats.designs import reach_beside, reach_of, read_design, run_of
        from lidardesign.run_folder import RunFolder
        from lidardesign.sensors.compare import outside_notes, readout_of
        from lidardesign.sensors.design_file import design_document, pattern_document
        from lidardesign.space import condition_values

    condition = condition_values(at)
    run = None if space_of is None else RunFolder.open(space_of)
    given = [run] if run else []
    files = [design] if other is None else [design, other]
    reach_m = reach_of(given) if other is None else reach_beside(files, given)
    read = [read_design(path, output.remark, reach_m) for path in files]
    shown = [one.at_condition(condition) if condition else one for one in read]
    if other is not None:
        return _show_differences(files, shown, output)
    specification = read[0]
    try:
        run = run or run_of(specification, design)
    except LidardesignError as error:  # its run is not needed to show a design
        if specification.constraints:
            output.remark(f"the design space is not checked: {error}")
    space = None if run is None else run.config.space
    checks = check_design(
        design_document(specification), specification.constraints, space if specification.constraints else None
    )
    outside = [] if space is None else outside_notes(specification, space)
    for line in (*outside, *broken_notes(specification.name, checks)):
        output.remark(line)
    specification = shown[0]
    reaches = []
    if any(sensor.part for sensor in specification.sensors):
        from lidardesign.simulate.calibration import reach_notes, reaches_of

        reaches = [vars(one) for one in reaches_of(specification)]
        for line in reach_notes(specification):
            output.remark(line)
    readout = readout_of(specification)
    document = {
        "design": str(design),
        "name": specification.name,
        "layout": specification.layout,
        "rays": specification.count,
        "level": specification.level,
        "at": dict(specification.at),
        "frame": specification.mount or "world",
        "sensors": [sensor.as_dict() for sensor in specification.sensors],
        "reaches": reaches,
        "patterns": [pattern_document(pattern) for pattern in specification.patterns],
        "constraints": specification.constraints,
        "checks": [
            {**check.as_dict(), "room": left.room, "tight": left.is_tight}
            for check, left in zip(checks, map(room_of, checks), strict=True)
        ],
        "bandwidth": readout.as_dict(),
        "certificates": [*specification.certificates],
        "provenance": specification.provenance,
    }

    def show_all(rich: RichConsole) -> None:
        show_design(specification, rich)
        show_constraints(checks, rich)
        _show_readout(readout, rich)

    output.result(document, show_all, show_costs=False)


def _show_run(folder: Path, given: Mapping[str, Any], output: Output) -> None:
    with phase("libraries"):
        from lidardesign.api.run import open_run

    for option in (option for option, value in given.items() if value):
        raise ConfigError("is for a design", where=option, hint="give a design of the run, or leave it out")
    run = open_run(folder)
    for line in run.input_notes():
        output.remark(line)
    document = run.summary()
    output.result(document, lambda rich: _show_summary(document, rich), show_costs=False)


def _show_summary(document: dict[str, Any], rich: RichConsole) -> None:
    quality, designs, metric = document["quality"], document["designs"], document["metric"]
    rich.print("run: {run}\ntask {task}, preset {preset}, seed {seed}".format_map(document), soft_wrap=True)
    if quality is None:
        rich.print(f"{document['writer']} is learning it" if document["writer"] else "learning was not finished")
    else:
        misplaced, kl, ess = 100 * quality["misplaced"], quality["kl_nats"], quality["ess"]
        learned = ""
        if None not in (document["seconds"], document["steps"]):
            learned = f"learned in {duration(document['seconds'])} ({document['steps']} steps); "
        rich.print(
            f"{learned}the density is {document['verdict']}: {misplaced:.2g} % misplaced, KL {kl:.2g} nats, "
            f"ESS {ess:.2f}",
            soft_wrap=True,
        )
        if document["advice"] is not None:
            rich.print(document["advice"], soft_wrap=True)
    fine = [entry for entry in designs if "error" not in entry]
    scored = any(entry["score"] for entry in fine)
    if fine:
        title = f"last scores: {metric['name']} [{metric['unit']}], {metric['better']} is better"
        columns = DESIGN_COLUMNS + VALUE_COLUMNS * scored
        rows = [_design_row(entry)[: len(columns)] for entry in fine]
        print_table(title if scored else None, columns, rows, rich, text=("design", "layout"))
    for entry in (entry for entry in designs if "error" in entry):
        rich.print(f"{entry['name']} cannot be read: {entry['error']}", soft_wrap=True)
    if quality is not None and not scored:
        rich.print("no scores yet" if fine else "no designs yet")
    if document["cache"]:
        path, megabytes = document["cache"]["path"], document["cache"]["bytes"] / 1e6
        rich.print(f"cached for later fits: {path}, {megabytes:.1f} MB", soft_wrap=True)
    if document["next"]:
        rich.print("\n".join(["next:", *(f"  {line}" for line in document["next"])]), soft_wrap=True)


def _design_row(entry: dict[str, Any]) -> list[str]:
    """A design and its last score; dashes where none is kept."""
    shape, score = [entry["name"], entry["layout"], number(entry["sensors"])], entry["score"]
    if score is None:
        return [*shape, number(entry["rays"]), "-", "-", "-"]
    difference = "-"
    if None not in (score["baseline"], score["difference"]):
        ends = {"ci_low": score["difference_low"], "ci_high": score["difference_high"]}
        difference = f"{difference_cell({**score, **ends}, sign='+')} to {score['baseline']}"
    under = [*score["settings"], *([score["detector"]] if score["detector"] != IDEAL else [])]
    return [*shape, number(score["rays"]), *value_cells(score), ", ".join([difference, *under])]


def _show_readout(readout: BandwidthUse, rich: RichConsole) -> None:
    model, low, high = readout.model, number(readout.low_mbps), number(readout.high_mbps)
    span = low if low == high else f"{low} .. {high}"
    rays = "each ray in a frame" if readout.rays is None else f"{readout.rays} rays per frame"
    bins = f"({number(model.bin_ps)} ps bins of {number(model.bits_per_bin)} bits, {number(model.rate_hz)} frames/s)"
    rich.print(f"bandwidth: {span} Mbit/s for {rays}\n{bins}", soft_wrap=True)


def _show_differences(files: Sequence[Path], designs: Sequence[DesignSpec], output: Output) -> None:
    """The sensors of two designs in pairs, what both cost, and the constraints that only one has or that differ."""
    from lidardesign.run.yaml import leaves
    from lidardesign.sensors.compare import difference, paired_sensors, readout_of
    from lidardesign.sensors.design_file import pattern_document

    ours, theirs = (dict(leaves(design.constraints)) for design in designs)
    keys = [key for key in {**ours, **theirs} if key and ours.get(key) != theirs.get(key)]
    document = {
        "designs": [
            {
                "design": str(path),
                "name": design.name,
                "layout": design.layout,
                "sensors": len(design.sensors),
                "bandwidth": readout_of(design).as_dict(),
            }
            for path, design in zip(files, designs, strict=True)
        ],
        "sensors": [difference(*pair) for pair in paired_sensors(*designs)],
        "rays_differ": len({repr([*map(pattern_document, design.patterns)]) for design in designs}) > 1,
        "constraints": {".".join(map(str, key)): [ours.get(key), theirs.get(key)] for key in keys},
    }
    output.result(document, lambda rich: _show_pair(document, rich), show_costs=False)


def _show_pair(document: dict[str, Any], rich: RichConsole) -> None:
    for place, design in zip(("first", "second"), document["designs"], strict=True):
        sensors = counted(design["sensors"], "sensor")
        cost = design["bandwidth"]
        rays = "rays left open" if cost["rays"] is None else f"{cost['rays']} rays, {number(cost['high_mbps'])} Mbit/s"
        rich.print(f"{place}: {design['name']}, {sensors}, layout {design['layout']}, {rays}", soft_wrap=True)
    lines = [
        [
            pair["a"],
            pair["b"],
            *(number(round(apart[name], DECIMALS), 3) for name in ("place_m", "boresight_deg")),
            _signed(apart["roll_deg"]),
            f"{_signed(apart['horizontal_deg'])} x {_signed(apart['vertical_deg'])}",
            *(_signed(apart[name], 3) for name in ("gate_start_m", "gate_end_m", "weight")),
        ]
        for pair in document["sensors"]
        if (apart := pair["difference"]) is not None
    ]
    print_table("sensors: second minus first", SENSOR_COLUMNS, lines, rich, text=SENSOR_COLUMNS[:2])
    for place, key, other in (("first", "a", "b"), ("second", "b", "a")):
        alone = [pair[key] for pair in document["sensors"] if pair[other] is None]
        if alone:
            rich.print(f"only in the {place}: {', '.join(alone)}", soft_wrap=True)
    if document["rays_differ"]:
        rich.print("their patterns differ: not the same rays, or in another order")
    rules = [
        (key, *("-" if one is None else str(one) for one in pair)) for key, pair in document["constraints"].items()
    ]
    if rules:
        print_table("constraints that differ", ("constraint", "first", "second"), rules, rich, text=("constraint",))


def _signed(value: float, decimals: int = 2) -> str:
    return f"{round(value, decimals) + 0.0:+.{decimals}f}"
