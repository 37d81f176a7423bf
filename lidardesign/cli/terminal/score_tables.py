"""The tables of an evaluation (scores, differences, equal bandwidth), of its accuracy, and of where the time went."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import compress
from typing import TYPE_CHECKING, Any

from lidardesign.cli.terminal.grids import RichConsole, difference_cell, duration, number, print_table, value_cells
from lidardesign.run.clock import INSIDE, OTHER
from lidardesign.run.markup import readable_number

if TYPE_CHECKING:
    from lidardesign.evaluation.results import Evaluation
    from lidardesign.evaluation.sweep import Accuracy, Measurement, Sweep


Entry = dict[str, Any]
MILLIMETRES = 1000.0
SHORT_S = 0.01
# Of the differences of an audit that tolerates none.
DECIMALS = 4


def show_evaluation(document: Entry, evaluation: Evaluation, rich: RichConsole, *, verbose: bool) -> None:
    """Print an evaluation for people: a row per design, with a verdict; or all tables.

    Its JSON form holds more (all pairs, all intervals).
    """
    if verbose:
        _show_all(document, rich)
    else:
        _show_designs(document, evaluation, rich)
    for note in document.get("notes", []):
        rich.print(f"note: {note}", soft_wrap=True)


def _show_designs(document: Entry, evaluation: Evaluation, rich: RichConsole) -> None:
    """Print a row per design and baseline of `baseline_rows`, and a line on each further result."""
    from lidardesign.evaluation.headline import difference_text, headline_texts

    rows, pairs = evaluation.headline_rows, evaluation.headline_pairs
    baseline = evaluation.strongest_baseline
    shown = [row.as_dict() for row in (*rows.values(), *evaluation.baseline_rows)]
    values, intervals = zip(*map(value_cells, shown), strict=True)
    columns = {
        "rays": [str(row["rays"]) for row in shown],
        "value": values,
        "95 % interval": intervals,
        "failures": [str(row["failures"]) for row in shown],
        "gates": [str(row["gates"]) for row in shown],
        "Mbit/s": [number(row["bandwidth_mbps"], 3) for row in shown],
    }
    if any("lost" in row for row in shown):
        columns["worst sensor lost"] = [number(row.get("worst_lost")) for row in shown]
    counts = {row.rays for row in rows.values()}
    if len(counts) == 1:
        del columns["rays"]
    if not any(row["failures"] for row in shown):
        del columns["failures"]
    if pairs and baseline is not None:
        apart = {name: difference_cell(pair.as_dict(), sign="+") for name, pair in pairs.items()}
        columns[f"difference to {baseline.name}"] = [apart.get(row["design"], "-") for row in shown]
    metric, names = evaluation.metric, [row["design"] for row in shown]
    rays = f" at {shown[0]['rays']} rays" if len(counts) == 1 else ""
    title = f"{metric.name} [{metric.unit}]{rays}, {_scenes(document)} ({metric.better} is better)"
    others = sorted({row.rays for row in evaluation.rows} - counts)
    rich.print(f"{title}; -v: {', '.join(map(str, others))} rays too" if others else title, soft_wrap=True)
    print_table(None, ("design", *columns), list(zip(names, *columns.values(), strict=True)), rich)
    for text in headline_texts(evaluation):
        rich.print(text, soft_wrap=True)
    if baseline is None:
        for pair in evaluation.paired:
            if pair.rays == rows[pair.a].rays:
                rich.print(difference_text(pair, metric.better, metric.unit), soft_wrap=True)
    if "mounting" in document:
        _show_mounting(document, rich, [row in rows.values() for row in evaluation.rows])
    if "audit" in document:
        rich.print(_audit_title(document["audit"], document["effects"]), soft_wrap=True)
    simulated = [_words(effect["name"]) for effect in document["effects"] if effect["on"]]
    if simulated:
        rich.print(f"effects with the detector {document['detector']}: {', '.join(simulated)}", soft_wrap=True)


def _scenes(document: Entry) -> str:
    seeds = document.get("seeds", [])
    scenes = f"{document['scenes']} held-out scenes" + (f" and {len(seeds)} seeds" if seeds else "")
    return ", ".join([scenes, *document.get("set", [])])


def _show_all(document: Entry, rich: RichConsole) -> None:
    metric, matched = document["metric"], document["equal_bandwidth"]
    _show_rows(document, rich)
    _show_errors(document, rich)
    designs = {row["design"] for row in document["rows"]} - {row["design"] for row in matched}
    against = [pair for pair in document["paired"] if pair["b"] not in designs] or document["paired"]
    if "mounting" in document:
        _show_mounting(document, rich, [True] * len(document["rows"]))
    title = f"differences [{metric['unit']}], scene by scene, with their 95 % intervals"
    cells = list(map(difference_cell, against))
    _show_grid(title, [(pair["a"], pair["rays"], pair["b"]) for pair in against], cells, rich)
    title = f"baselines with as much bandwidth as the design: value [{metric['unit']}] (rays)"
    cells = [f"{number(row['value'])} ({row['rays']})" for row in matched]
    _show_grid(title, [(row["matched_to"], row["matched_rays"], row["design"]) for row in matched], cells, rich)
    _show_effects(document, rich)
    if "audit" in document:
        _show_audit(document["audit"], document["effects"], rich)


def _show_rows(document: Entry, rich: RichConsole) -> None:
    metric, rows = document["metric"], document["rows"]
    title = f"{metric['name']} [{metric['unit']}], {metric['better']} is better, over {_scenes(document)}"
    details = [name for row in rows for name in row["details"]][:1]
    further = [name.replace("_", " ") for name in details]
    worst = {"worst_decile": "worst tenth", "worst_lost": "worst lost"}
    worst = {name: heading for name, heading in worst.items() if any(name in row for row in rows)}
    headings = ("design", "rays", "value", "95 % interval", *worst.values(), "failures", *further, "Mbit/s", "seconds")
    lines = []
    for row in rows:
        extra = [*map(row.get, worst), row["failures"], *map(row["details"].get, details)]
        cells = (row["rays"], *value_cells(row), *extra, row["bandwidth_mbps"])
        lines.append([row["design"], *(number(cell) for cell in cells), number(row["seconds"], 2)])
    print_table(title, headings, lines, rich)
    places = [(row["design"], row["rays"], f"seed {seed}") for row in rows for seed in document.get("seeds", [])]
    cells = [number(value) for row in rows for value in row.get("per_seed", [])]
    _show_grid(f"value of each seed [{metric['unit']}]", places, cells, rich)


def _show_mounting(document: Entry, rich: RichConsole, shown: Sequence[bool]) -> None:
    found, unit, exact = document["mounting"], document["metric"]["unit"], document["rows"]
    off = f"{MILLIMETRES * found['place_m']:.3g} mm and {math.degrees(found['angle_rad']):.3g} degrees"
    lines = []
    for row, own in compress(zip(found["rows"], exact, strict=True), shown):
        figures = map(number, (row["rays"], own["value"], row["value"], row["failures"]))
        lines.append([row["design"], *figures, difference_cell(row["cost"])])
    headings = (
        "design",
        "rays",
        f"exact\n[{unit}]",
        f"with errors\n[{unit}]",
        "failures",
        "difference (95 % interval)",
    )
    print_table(f"with mounting errors: every sensor off by {off} per axis", headings, lines, rich)


def _audit_title(audit: Entry, effects: Sequence[Entry]) -> str:
    there = {effect["name"] for effect in effects if effect["bound"] or effect["lost"]}
    skipped = ", ".join(_words(name) for name in audit["skipped"] if name in there) or "nothing that the scenes have"
    verdict = "passed" if audit["passed"] else "failed"
    return f"audit {verdict}: the plan skips {skipped}; rows may move by {audit['tolerance']:g} {audit['unit']}"


def _show_audit(audit: Entry, effects: Sequence[Entry], rich: RichConsole) -> None:
    unit, tolerance = audit["unit"], audit["tolerance"]
    scores = (f"planned\n[{unit}]", f"all effects\n[{unit}]", "difference (95 % interval)")
    headings = ("design", "bandwidth\nof", "rays", *scores, "seconds\nof both")
    # as many as show hundredths of what is tolerated
    decimals = max(0, 2 - math.floor(math.log10(tolerance))) if tolerance > 0 else DECIMALS
    lines = []
    for row in audit["rows"]:
        # adding zero takes the sign from a rounded -0
        figures = (row[name] for name in ("difference", "ci_low", "ci_high"))
        moved, low, high = ("-" if one is None else f"{round(one, decimals) + 0.0:.{decimals}f}" for one in figures)
        cells = (str(row["rays"]), number(row["planned"]), number(row["everything"]), f"{moved} ({low} to {high})")
        times = f"{number(row['seconds'], 2)}, {number(row['seconds_everything'], 2)}"
        lines.append([row["design"], row.get("matched_to", "-"), *cells, times])
    print_table(_audit_title(audit, effects), headings, lines, rich, text=headings[:2])


def _show_errors(document: Entry, rich: RichConsole) -> None:
    designs, unit = {pair["a"] for pair in document["paired"]}, document["metric"]["unit"]
    if designs and all(row["half_width"] is not None for row in document["rows"]):
        value = max(row["half_width"] for row in document["rows"] if row["design"] in designs)
        difference = max(pair["half_width"] for pair in document["paired"])
        rich.print(
            f"over other scenes, designs' values may be off by up to {number(value, 2)} {unit}, "
            f"their differences by up to {number(difference, 2)} {unit} (half of the 95 % intervals)"
        )


def _show_grid(title: str, places: Sequence[tuple[str, int, str]], cells: Sequence[str], rich: RichConsole) -> None:
    """Print a line per design and number of rays with a column per baseline; `places` are these three."""
    columns = list(dict.fromkeys(column for _, _, column in places))
    lines: dict[tuple[str, int], dict[str, str]] = {}
    for (design, rays, column), cell in zip(places, cells, strict=True):
        lines.setdefault((design, rays), {})[column] = cell
    rows = [
        [design, str(rays), *(line.get(column, "-") for column in columns)] for (design, rays), line in lines.items()
    ]
    if rows:
        print_table(title, ("design", "rays", *columns), rows, rich)


def _show_effects(document: Entry, rich: RichConsole) -> None:
    """Print the effects that were simulated with the reasons; one line where none was needed."""
    detector, effects = document["detector"], document["effects"]
    if not any(effect["on"] or effect["bound"] or effect["lost"] for effect in effects):
        rich.print(f"effects: none needed with the detector {detector}", soft_wrap=True)
        return
    first = effects[0]
    allowed = f"{MILLIMETRES * first['tolerance']:.3g} mm and {first['lost_tolerance']:.2g} of returns"
    title = f"effects with the detector {detector}; those that are skipped may change {allowed} together"
    lines = []
    for effect in effects:
        bounds = [readable_number(MILLIMETRES * effect["bound"], 3), readable_number(effect["lost"], 2)]
        cost = readable_number(effect["seconds"], 2, tiny=SHORT_S)
        on = "no" if effect["missing"] is None else "missing"
        if effect["on"]:
            on = "yes" if effect["scenes_on"] == 1 else f"in {100 * effect['scenes_on']:.0f} %"
        lines.append([_words(effect["name"]), on, *bounds, cost, effect["reason"]])
    headings = ("effect", "on", "range [mm]", "returns", "cost [s]", "reason")
    print_table(title, headings, lines, rich, text=("effect", "on", "reason"), wraps=True)


def _words(name: str) -> str:
    return name.replace("_", " ")


# Phases of a smaller share are left to --json; `other` shows what they took.
LEAST_SHARE = 0.005
MEBIBYTE = 1024**2


def show_times(timings: Mapping[str, float], memory_bytes: int | None, rich: RichConsole) -> None:
    """Print the phases of a clock's timings with their seconds and shares, phases inside of phases indented."""
    # people are shown phases and those directly inside of them
    timings = {key: seconds for key, seconds in timings.items() if key.count(INSIDE) < 2}
    total = sum(seconds for key, seconds in timings.items() if INSIDE not in key)
    if total <= 0:
        return
    shown = {key: seconds for key, seconds in timings.items() if key != OTHER and seconds >= LEAST_SHARE * total}
    shown[OTHER] = total - sum(seconds for key, seconds in shown.items() if INSIDE not in key)
    lines = [
        ("  " * key.count(INSIDE) + key.split(INSIDE)[-1], f"{seconds:.2f}", f"{100 * seconds / total:.0f} %")
        for key, seconds in shown.items()
    ]
    memory = "" if memory_bytes is None else f"; peak memory: {memory_bytes / MEBIBYTE:.0f} MiB"
    print_table(f"where the time went{memory}", ("phase", "seconds", "share"), lines, rich, text=("phase",))


def show_accuracy(accuracy: Accuracy, rich: RichConsole, *, verbose: bool) -> None:
    """Print the verdicts that ask for another setting; or every sweep, the roughest measurement first."""
    for sweep in accuracy.sweeps if verbose else ():
        unit = f" [{sweep.unit}]" if sweep.unit else ""
        title = f"{sweep.knob}: {sweep.error_of}{unit}, against {sweep.against}; seconds of {sweep.work}"
        further = list(dict.fromkeys(name for measurement in sweep.measurements for name in measurement.values))
        lines = [
            (*_cells(measurement, sweep), *(_figure(measurement.values.get(name)) for name in further))
            for measurement in sweep.measurements
        ]
        # a sentence, which wraps like those below the table
        rich.print(title, style="italic")
        print_table(None, ("setting", "error", "+-", "seconds", "memory", *further), lines, rich, text=("setting",))
        rich.print(f"{sweep.verdict}; tolerance {sweep.tolerance:.3g}{unit}: {sweep.because}")
        if sweep.note:
            rich.print(f"note: {sweep.note}")
        rich.print()
    marks = "; * is what to choose, (run) what this run does" if verbose else ""
    rich.print(f"accuracy measured in {duration(sum(accuracy.seconds.values()))}{marks}")
    for sweep in accuracy.sweeps:
        if sweep.default is not None and sweep.chosen is not sweep.default:
            rich.print(f"note: {sweep.knob}: {sweep.verdict}")


def _cells(measurement: Measurement, sweep: Sweep) -> tuple[str, ...]:
    marks = (" *" if measurement is sweep.chosen else "") + (" (run)" if measurement.default else "")
    error = (
        ("reference", "") if measurement.reference else (_figure(measurement.error), _figure(measurement.uncertainty))
    )
    memory = "" if measurement.memory_bytes is None else f"{measurement.memory_bytes / MEBIBYTE:.0f} MiB"
    return measurement.setting + marks, *error, _figure(measurement.seconds), memory


def _figure(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
