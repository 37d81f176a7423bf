"""Our designs against every baseline on faces, the aisle and the arm, over several seeds, at equal rays and bandwidth.

For each seed a density is learned and designs are fitted as `fit RUN` does without options (`fit`), and with a gate of
its own for every ray (`per-ray`); each run brings baselines built from its own training scenes. All are scored in the
held-out scenes of one seed, on which nothing was chosen. Intervals are over seeds and scenes. What was measured is
kept in the folder, and measured again only where it is missing.

    python benchmarks/baselines.py --folder baselines --page docs/baselines.md --picture docs/baselines.png
"""

from __future__ import annotations

import datetime
import json
import platform
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import face_settings, lidardesign, parser, report, run_process, table, verdict

HELD_OUT_SEED = 2035  # of the scenes that designs are judged in: no choice, of a rule or of a number, was made on them
SEEDS = 5
DESIGNS: Mapping[str, tuple[str, ...]] = {"fit": (), "per-ray": ("--gates", "ray")}


@dataclass(frozen=True)
class Case:
    """What is compared on one task.

    Arguments:
        title: For tables.
        rays: Numbers of rays.
        baselines: Baselines beside those that `evaluate` always has.
        designs: Which of our designs.
    """

    title: str
    rays: tuple[int, ...]
    baselines: tuple[str, ...]
    designs: tuple[str, ...] = tuple(DESIGNS)


CASES = {
    "face": Case("Faces", (196, 361, 576), ("lloyd", "occupancy")),
    "warehouse": Case("Aisle", (6, 12, 18), ("occupancy",), ("fit",)),
    "arm": Case("Arm", (400, 1000), ("occupancy",)),
}


def runs_of(task: str, options: Any) -> list[Path]:
    """One run with its designs for each seed, made where they are missing."""
    case, runs = CASES[task], []
    settings = face_settings(options.model) if task == "face" else {}
    words = [word for one in (*(f"{k}={v}" for k, v in settings.items()), *options.set) for word in ("--set", one)]
    for seed in range(options.seeds):
        run = options.folder / f"{task}-{seed}"
        if not (run / "samples.npz").exists():
            command = lidardesign(
                "learn", task, "--preset", options.preset, "--seed", str(seed), "--out", run, "--json"
            )
            run_process([*command, *words]).document()
        for name in case.designs:
            if not (run / "designs" / f"{name}.yaml").exists():
                print(f"{run.name}: {name} ...", file=sys.stderr, flush=True)
                run_process(lidardesign("fit", run, "--name", name, "--json", *DESIGNS[name])).document()
        runs.append(run)
    return runs


def measured(task: str, options: Any) -> dict[str, Any]:
    """What `evaluate` prints of all seeds of a task, and where and when that was measured."""
    path = options.folder / f"{task}.json"
    if not path.exists():
        case, runs = CASES[task], runs_of(task, options)
        words: list[str | Path] = ["evaluate", *runs, "--scenes-seed", str(HELD_OUT_SEED), "--json"]
        for option, values in (
            ("--designs", case.designs),
            ("--rays", options.rays or case.rays),
            ("--baseline", case.baselines),
        ):
            words += [word for value in values for word in (option, str(value))]
        print(f"{task}: evaluate ...", file=sys.stderr, flush=True)
        document = run_process(lidardesign(*words)).document()
        path.write_text(json.dumps({"where": measured_on(), **document}, indent=1) + "\n", encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def measured_on() -> str:
    """When and with what something was measured."""
    return f"Measured on {datetime.date.today():%Y-%m-%d} with Python {platform.python_version()}."


def standing(pair: Mapping[str, Any], better: str) -> str:
    """Whether `a` is better than `b` by more than the interval."""
    if pair["ci_low"] * pair["ci_high"] <= 0:
        return "no significant difference"
    lower = pair["difference"] < 0
    return "better" if lower == (better == "lower") else "worse"


def percent(pair: Mapping[str, Any] | None) -> str:
    """By how much `a` is above `b` with its interval, in percent; nothing where that is not known."""
    if pair is None or pair["percent"] is None:
        return ""
    middle, low, high = pair["percent"]
    return f"{middle:+.1f} ({low:+.1f} to {high:+.1f})"


def told(pair: Mapping[str, Any] | None, better: str) -> str:
    """By how much `a` is above `b` with its interval, in percent, and what the difference says."""
    return "" if pair is None else ", ".join(filter(None, [percent(pair), standing(pair, better)]))


def ours_of(found: Mapping[str, Any]) -> list[str]:
    """Which of our designs the baselines are held against."""
    there = {row["design"] for row in found["rows"]}
    return [name for name in DESIGNS if name in there]


def equal_rays(found: Mapping[str, Any]) -> list[list[object]]:
    """One row per number of rays and design or baseline, with how much better ours are."""
    pairs = {(pair["a"], pair["b"], pair["rays"]): pair for pair in found["paired"]}
    rows: list[list[object]] = []
    for row in sorted(found["rows"], key=lambda row: row["rays"]):
        count, other, value = row["rays"], row["design"], row["value"]
        against = [told(pairs.get((name, other, count)), found["metric"]["better"]) for name in ours_of(found)]
        interval = f"{row['ci_low']:.3g} to {row['ci_high']:.3g}"
        rows.append([count, other, value, interval, row["bandwidth_mbps"], *against])
    return rows


def equal_bandwidth(found: Mapping[str, Any]) -> list[list[object]]:
    """One row per number of rays, design and baseline in its bandwidth."""
    spent = {(row["design"], row["rays"]): row["bandwidth_mbps"] for row in found["rows"]}
    pairs = {(pair["a"], pair["b"], pair["rays"]): pair for pair in found["paired_equal_bandwidth"]}
    rows = []
    for row in sorted(found["equal_bandwidth"], key=lambda row: (row["matched_rays"], row["matched_to"])):
        ours, count = row["matched_to"], row["matched_rays"]
        against = told(pairs.get((ours, row["design"], count)), found["metric"]["better"])
        rows.append([count, ours, spent[ours, count], row["design"], row["rays"], row["value"], against])
    return rows


def standings(found: Mapping[str, Any], name: str, key: str) -> tuple[dict[str, bool], dict[str, bool]]:
    """Where a design is better than baselines that choose no rays, and where it is not worse than `greedy`."""
    others, greedy = {}, {}
    for pair in found[key]:
        if pair["a"] != name or pair["b"] in DESIGNS:
            continue
        stands = standing(pair, found["metric"]["better"])
        if pair["b"] == "greedy":
            greedy[f"{pair['rays']} rays"] = stands != "worse"
        else:
            others[f"{pair['rays']} rays, {pair['b']}"] = stands == "better"
    return others, greedy


PAIRED = {"paired": "rays", "paired_equal_bandwidth": "bandwidth"}


def verdicts(found: Mapping[str, Any]) -> list[str]:
    """What is claimed of our designs, over all numbers of rays: of baselines that choose no rays, and of `greedy`."""
    lines = []
    for name in ours_of(found):
        for key, where in PAIRED.items():
            others, greedy = standings(found, name, key)
            lines.append(
                verdict(f"{name} is better by the interval than baselines that choose no rays, equal {where}", others)
            )
            lines.append(verdict(f"{name} is not worse than greedy by the interval, equal {where}", greedy))
    return lines


def counted(found: Mapping[str, Any], name: str) -> str:
    """In how many comparisons one design is better than baselines that choose no rays, and worse than `greedy`."""
    others, greedy = zip(*(standings(found, name, key) for key in PAIRED), strict=True)
    first, second = (f"{sum(stands.values())} of {len(stands)}" for stands in others)
    third, fourth = (f"{len(stands) - sum(stands.values())} of {len(stands)}" for stands in greedy)
    beaten = f"better than {first}, worse than `greedy` in {third}"
    return f"`{name}`, equal rays: {beaten}; equal bandwidth: {second}, {fourth}."


def page_tables(found: Mapping[str, Any]) -> list[str]:
    """Scores at each number of rays, and in the middle what the first design is worth beside the others."""
    rows = {(row["design"], row["rays"]): row for row in found["rows"]}
    counts = sorted({count for _, count in rows})
    middle = counts[(len(counts) - 1) // 2]
    ours = ours_of(found)[0]
    pairs = {pair["b"]: pair for pair in found["paired"] if (pair["a"], pair["rays"]) == (ours, middle)}
    paired = {p["b"]: p for p in found["paired_equal_bandwidth"] if (p["a"], p["rays"]) == (ours, middle)}
    scores, differences = [], []
    for name in dict.fromkeys(row["design"] for row in found["rows"]):
        values = [rows[name, count]["value"] for count in counts]
        scores.append([f"`{name}`", *values, rows[name, middle]["bandwidth_mbps"]])
        if name in pairs:
            differences.append([f"`{name}`", percent(pairs[name]), percent(paired.get(name))])
    columns = [found["metric"]["unit"], *(f"{count} rays" for count in counts), f"Mbit/s at {middle}"]
    against = [f"`{ours}` against", f"at {middle} rays, %", "in the same bandwidth, %"]
    return [table(columns, scores), table(against, differences)]


def tables_of(title: str, found: Mapping[str, Any]) -> dict[str, tuple[list[str], list[list[object]]]]:
    """Captions, columns and rows of one task."""
    metric = f"{found['metric']['name']} {found['metric']['unit']}"
    scenes = f"{found['scenes']} held-out scenes"
    against = [f"{name} against it, %" for name in ours_of(found)]
    return {
        f"{title}, equal rays, {scenes}": (
            ["rays", "design", metric, "95 % interval", "Mbit/s", *against],
            equal_rays(found),
        ),
        f"{title}, equal bandwidth, {scenes}": (
            ["rays", "design", "Mbit/s", "baseline", "its rays", metric, "design against it, %"],
            equal_bandwidth(found),
        ),
    }


def draw(everything: Mapping[str, dict[str, Any]], path: Path) -> None:
    """Scores against rays and against bandwidth, one row of axes per task."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = Figure(figsize=(11, 3.6 * len(everything)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(everything), 2, squeeze=False)
    names = list(dict.fromkeys(name for found in everything.values() for name in curves(found)))
    colours = {name: colormaps["tab20"](index % 20) for index, name in enumerate(names)}
    for (task, found), (left, right) in zip(everything.items(), grid, strict=True):
        metric = found["metric"]
        for name, points in curves(found).items():
            ours = name in DESIGNS
            style = {"marker": "o" if ours else "s", "lw": 2.2 if ours else 1.0, "ms": 6 if ours else 4}
            style |= {"ls": "-" if ours else "--", "label": name, "color": colours[name]}
            left.plot(points["rays"], points["value"], **style)
            right.plot(points["bandwidth_mbps"], points["value"], **style)
        left.set(xlabel="rays", ylabel=f"{metric['name']} [{metric['unit']}]", yscale="log", title=CASES[task].title)
        right.set(xlabel="Mbit/s", xscale="log", yscale="log")
        right.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
        for axes in (left, right):
            axes.grid(True, which="both", alpha=0.25)
            for axis in (axes.yaxis, *([axes.xaxis] if axes is right else [])):
                axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axis.set_minor_formatter(NullFormatter())
    figure.savefig(path, dpi=100)


def curves(found: Mapping[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Rays, bandwidths and scores of each design and baseline, at ascending numbers of rays."""
    lines: dict[str, dict[str, list[float]]] = {}
    for row in sorted(found["rows"], key=lambda row: row["rays"]):
        line = lines.setdefault(row["design"], {"rays": [], "bandwidth_mbps": [], "value": []})
        for key, values in line.items():
            values.append(row[key])
    return lines


def write_page(page: Path, everything: Mapping[str, dict[str, Any]]) -> None:
    """Put tables and verdicts between the marks `<!-- TASK -->` of the tasks that were measured.

    Raises:
        SystemExit: The page does not have a mark exactly twice.
    """
    text = page.read_text(encoding="utf-8")
    for task, found in everything.items():
        mark = f"<!-- {task} -->"
        parts = text.split(mark)
        if len(parts) != 3:
            sys.exit(f"the page has the mark {mark} {len(parts) - 1} times, not twice")
        metric = f"{found['metric']['name']} in {found['metric']['unit']}"
        said = f"{metric[:1].upper()}{metric[1:]} on {found['scenes']} held-out scenes. {found['where']}"
        lines = [textwrap.fill(f"- {counted(found, name)}", 120, subsequent_indent="  ") for name in ours_of(found)]
        filled = "\n\n".join([textwrap.fill(said, 120), *page_tables(found), "\n".join(lines)])
        text = f"{parts[0]}{mark}\n\n{filled}\n\n{mark}{parts[2]}"
    page.write_text(text, encoding="utf-8")


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs, designs and results are kept")
    made.add_argument("--task", choices=list(CASES), action="append", help="only this task; repeatable")
    made.add_argument("--seeds", type=int, default=SEEDS, help="how many runs are learned (default %(default)s)")
    made.add_argument("--model", default="ict", help="face model: ict, embedded, or a file (default %(default)s)")
    made.add_argument("--preset", default="standard", help="what is learned (default %(default)s)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    made.add_argument("--rays", type=int, nargs="+", help="numbers of rays (default: those of each task)")
    made.add_argument("--page", type=Path, metavar="FILE.md", help="put the tables between this page's marks")
    made.add_argument("--picture", type=Path, metavar="FILE.png", help="draw scores against rays and bandwidth")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    everything = {task: measured(task, options) for task in options.task or CASES}
    tables: dict[str, tuple[list[str], list[list[object]]]] = {}
    lines = []
    for task, found in everything.items():
        tables |= tables_of(CASES[task].title, found)
        lines += [f"{CASES[task].title}: {line}" for line in verdicts(found)]
    report("Baselines", tables, lines, options.json)
    if options.page is not None:
        write_page(options.page, everything)
    if options.picture is not None:
        draw(everything, options.picture)


if __name__ == "__main__":
    main()
