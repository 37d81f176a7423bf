"""Tables of designs for `show`, `fit` and `constrain`: sensors, constraints and certificates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lidardesign.cli.terminal.grids import RichConsole, number, print_table, text_table
from lidardesign.run.markup import counted

if TYPE_CHECKING:
    import numpy as np

    from lidardesign.constraints.check import ConstraintCheck
    from lidardesign.sensors.design import DesignSpec

MOST_ROWS = 20
MOST_NAMED = 4
# Constraints that leave more of the density than this cost it nothing.
MOST_ADMISSIBLE = 0.995
ERROR_DIGITS = 2
# Relative errors below what `number` shows of a figure are left out.
SMALLEST_ERROR = 1e-4
SPACE_MARK = ".space."
LEAST_GAP = 0.0005  # of a certificate, that shows as a tenth of a percent


def with_error(estimate: dict[str, Any]) -> str:
    """A value and its standard error, rounded to the error's digits, as `-3.142 +- 0.005`."""
    value, error = estimate["value"], estimate["error"]
    if not error or error < SMALLEST_ERROR * abs(value):
        return number(value)
    decimals = max(0, ERROR_DIGITS - 1 - math.floor(math.log10(error)))
    return f"{value:.{decimals}f} +- {error:.{decimals}f}"


def show_design(design: DesignSpec, rich: RichConsole) -> None:
    """Print a design's sensors as a table, with angles in degrees; a place that all share stands above it."""
    if design.condition is not None:
        _show_along(design, rich)
    else:
        rays = f"{design.count} rays per frame" if design.count else "rays per frame left open"
        title = f"{_name(design)}, layout {design.layout}, {rays}{_condition(design)}"
        where, poses = _poses(design)
        cells = [
            {"sensor": pose["sensor"], "weight": f"{sensor.weight:.3f}", "rays": number(rays), **pose}
            for sensor, rays, pose in list(zip(design.sensors, _rays_of(design), poses, strict=True))[:MOST_ROWS]
        ]
        headings = [name.replace(" [deg]", "\n[deg]") for name in cells[0]]
        rich.print(
            text_table(headings, (row.values() for row in cells), f"{title}\n{where}", headings[1:], overflow="fold")
        )
        if len(design.sensors) > MOST_ROWS:
            rich.print(f"... and {len(design.sensors) - MOST_ROWS} more sensors; --json lists all")
    _show_certificates(design, rich)


def _show_certificates(design: DesignSpec, rich: RichConsole) -> None:
    """Print the loss of chosen rays, and by how much any choice of the same candidates could lower it."""
    columns = ("rays", "loss", "on other scenes", "less by at most", "candidates", "scenes")
    rows = [
        (
            str(entry["rays"]),
            number(entry["value"]),
            number(entry["held_back_value"]),
            f"{100 * entry['gap']:.1f} %",
            str(entry["candidates"]),
            str(entry["scenes"]),
        )
        for entry in design.certificates
    ]
    if rows:
        rich.print(text_table(columns, rows, "\nrays chosen on training scenes", columns))
    if design.adaptive is not None:
        rich.print(f"{len(design.adaptive.patterns)} patterns of {len(design.adaptive)} rays follow what they see")


def _rays_of(design: DesignSpec) -> list[int | None]:
    """Rays of each sensor at the largest number of rays of the design; None where that is open."""
    counts = design.rays_per_sensor()
    return [None] * len(design.sensors) if counts is None else counts.tolist()


def _show_along(design: DesignSpec, rich: RichConsole) -> None:
    """Print the range of each ray's angles and gate along a condition."""
    from numpy import degrees

    pattern, name = design.patterns[-1], design.condition
    first, last = pattern.ends
    title = f"{design.name}: {len(pattern)} rays at every {name} from {first:g} to {last:g}"
    title += (
        f" (travel {last - first:g} m, {len(pattern.knots)} knots)\n"
        f"sensors at {design.sensors[0].as_text()['origin [m]']} m in {design.frame}, carried along {name}"
    )
    figures = ("azimuth\n[deg]", "elevation\n[deg]", "gate start\n[m]", "gate end\n[m]", "gate width\n[m]")
    rows = [
        (
            design.sensors[sensor].name,
            _span(degrees(pattern.azimuth_rad[:, ray]), 2),
            _span(degrees(pattern.elevation_rad[:, ray]), 2),
            _span(pattern.gate_m[:, ray, 0], 3),
            _span(pattern.gate_m[:, ray, 1], 3),
            _span(pattern.gate_m[:, ray, 1] - pattern.gate_m[:, ray, 0], 3),
        )
        for ray, sensor in list(enumerate(pattern.sensor))[:MOST_ROWS]
    ]
    rich.print(text_table(("ray", *figures), rows, title, figures, overflow="fold"))
    if len(pattern) > MOST_ROWS:
        rich.print(f"... and {len(pattern) - MOST_ROWS} more rays; --json lists all")
    rich.print(f"--at {name}=VALUE shows the rays at one place")


def _span(values: np.ndarray, decimals: int) -> str:
    low, high = (f"{round(float(v), decimals) + 0.0:.{decimals}f}" for v in (values.min(), values.max()))
    return low if low == high else f"{low} .. {high}"


def _name(design: DesignSpec) -> str:
    return f"{design.name}: {counted(len(design.sensors), 'sensor')}"


def _condition(design: DesignSpec) -> str:
    return "".join(f", at {name}={value:g}" for name, value in design.at.items())


def _poses(design: DesignSpec) -> tuple[str, list[dict[str, str]]]:
    """The place of a design in words, and the table cells of its sensors; without origins where all share one."""
    cells = [sensor.as_text() for sensor in design.sensors]
    if any(sensor.part for sensor in design.sensors):
        from lidardesign.simulate.calibration import reaches_of

        cells = [cell | reach.as_text() for cell, reach in zip(cells, reaches_of(design), strict=True)]
    if len({cell["origin [m]"] for cell in cells}) > 1:
        return f"in {design.frame}", cells
    rest = [{name: text for name, text in cell.items() if name != "origin [m]"} for cell in cells]
    return f"all at {cells[0]['origin [m]']} m in {design.frame}", rest


def show_constraints(checks: Sequence[ConstraintCheck], rich: RichConsole) -> None:
    """Print a table of constraints: bound, value and whether it holds.

    The bounds of the design space hold for every sensor; they are shown where they are broken.
    """
    from lidardesign.constraints.slack import room_of

    rows = []
    for check in checks:
        if SPACE_MARK not in check.name or not check.satisfied:
            left = room_of(check)
            holds = ("yes, tight" if left.is_tight else "yes") if check.satisfied else "no"
            rows.append((check.name, number(check.bound, 6), number(check.value, 6), _left(*left), holds))
    if rows:
        table = text_table(("constraint", "bound", "value", "left", "holds"), rows, "\nconstraints")
        table.columns[0].overflow = "fold"  # names are needed whole, to loosen what they name
        rich.print(table)


def _left(room: float | None, share: float | None) -> str:
    """The slack of a constraint, with its share of the bound; a dash where it is broken or has none."""
    if room is None or room < 0:
        return "-"
    # slack below the rounding of the checks counts as none
    if room == 0 or (share is not None and share < SMALLEST_ERROR):
        return "0"
    return number(room, 3) if share is None else f"{number(room, 3)} ({number(100 * share, 2)} %)"


def show_fit(
    document: dict[str, Any], design: DesignSpec, checks: Sequence[Any], rich: RichConsole, *, verbose: bool
) -> None:
    """Print the result of `fit` and `constrain`: sensors, choice of rays, tight constraints; or all tables."""
    if not verbose:
        _show_sensors(design, rich)
        _show_choice(design, rich)
        mass = document.get("error_estimates", {}).get("admissible_mass")
        if mass is not None and mass["value"] < MOST_ADMISSIBLE:
            rich.print(f"the constraints leave {100 * mass['value']:.2g} % of the density")
        if checks:
            rich.print(_tight(checks, [sensor.name for sensor in design.sensors]), soft_wrap=True)
        return
    show_design(design, rich)
    show_constraints(checks, rich)
    figures = {"log-likelihood": "log_likelihood", "ESS": "ess", "density inside the constraints": "admissible_mass"}
    estimates = document.get("error_estimates", {})
    known = [f"{name} {with_error(estimates[key])}" for name, key in figures.items() if key in estimates]
    if "seconds" in document:
        known.append(f"{number(document['seconds'], 3)} s" + (" (+- are standard errors)" if known else ""))
    rich.print(", ".join(known))


def _show_sensors(design: DesignSpec, rich: RichConsole) -> None:
    """Print a line per sensor, with its rays at the largest number of rays."""
    counts = [str(count) for count in design.counts or [design.count] if count is not None]
    several = f"{', '.join(counts[:-1])} or " if counts[:-1] else ""
    rays = f"{several}{counts[-1]} rays {_frames(design)}" if counts else "any number of rays"
    rich.print(f"{_name(design)}, {rays} (layout {design.layout}){_condition(design)}", soft_wrap=True)
    where, cells = _poses(design)
    rich.print(where, soft_wrap=True)
    if counts:
        heading = f"rays of {counts[-1]}" if several else "rays"
        rayed = zip(_rays_of(design), cells, strict=True)
        cells = [{"sensor": cell["sensor"], heading: number(rays), **cell} for rays, cell in rayed]
    print_table(None, list(cells[0]), [list(cell.values()) for cell in cells[:MOST_ROWS]], rich, text=("sensor",))
    if len(cells) > MOST_ROWS:
        rich.print(f"... and {len(design.sensors) - MOST_ROWS} more sensors; --json lists all")


def _frames(design: DesignSpec) -> str:
    """The unit of a number of rays: per frame, or at every value of a condition."""
    if design.condition is None:
        return "per frame"
    first, last = design.patterns[-1].ends
    return f"at every {design.condition} from {first:g} to {last:g}"


def _show_choice(design: DesignSpec, rich: RichConsole) -> None:
    """Print the numbers of candidates and scenes of a choice, its loss and the lower bound of the loss."""
    from lidardesign.sensors.design import MOST_GAP

    if design.certificates:
        last, are_parts = design.certificates[-1], all(sensor.part is not None for sensor in design.sensors)
        what, count = ("poses of parts", len(design.sensors)) if are_parts else ("rays", last["rays"])
        text = f"chosen among {last['candidates']} {what} on {last['scenes']} training scenes"
        if last["gap"] <= MOST_GAP:
            least = f"could be more than {100 * last['gap']:.1f} % better" if last["gap"] >= LEAST_GAP else "is better"
            text += f"; no other choice of {count} {least} there"
        rich.print(text, soft_wrap=True)


def _tight(checks: Sequence[ConstraintCheck], sensors: Sequence[str]) -> str:
    """The tight constraints of a design with their sensors, as a sentence."""
    from lidardesign.constraints.slack import room_of, split_name

    tight: dict[str, list[str]] = {}
    for check in checks:
        if SPACE_MARK not in check.name and room_of(check).is_tight:
            owner, key = split_name(check.name, sensors)
            tight.setdefault(key, []).extend([owner] * bool(owner))

    def owners(names: Sequence[str]) -> str:
        if len(names) == len(sensors) > 1:
            return " (all sensors)"
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        return f" ({', '.join(names[:MOST_NAMED])}{more})" if names else ""

    if not tight:
        return "no constraint is tight"
    return f"tight: {', '.join(f'{key}{owners(names)}' for key, names in tight.items())}"
