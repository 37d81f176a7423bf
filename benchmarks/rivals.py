"""Our designs against every rival on faces, the arm and the warehouse, at equal rays and at equal bandwidth.

For each number of rays designs are fitted to one run and scored on held-out scenes beside uniform, random and bounding
rays, an occupancy grid, real parts, and direct optimisation by CMA-ES about the first design (`chosen`), with as much
wall time for one answer as learning, ten changes of a constraint and choosing rays once take here; `--long` gives it
ten times as much besides. Differences are of the same scenes, with their 95 % intervals. What was measured is kept in
the folder, and measured again only where it is missing.

    python benchmarks/rivals.py --folder rivals --long --page docs/rivals.md --picture docs/rivals.png
"""

from __future__ import annotations

import datetime
import json
import shutil
import statistics
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import face_settings, learned, lidardesign, machine, parser, report, run_process, table, verdict

CHANGES = 10
LONG = 10
LONG_NAME = "cma, 10 times as long"
LEAST_FACTOR = 50.0
FIRST = "chosen"
OURS = (FIRST, "per-ray")  # that the rivals are held against


@dataclass(frozen=True)
class Case:
    """What is compared on one task.

    Arguments:
        title: For tables.
        designs: What `constrain` is told for each of our designs; the number of rays comes on top. The first is
            `chosen`, which is told nothing.
        rays: Numbers of rays.
        baselines: Rivals beside those that `evaluate` always has.
        change: The constraint whose change is timed.
    """

    title: str
    designs: Mapping[str, tuple[str, ...]]
    rays: tuple[int, ...]
    baselines: tuple[str, ...]
    change: str

    def words(self, name: str, rays: int) -> list[str]:
        """What `constrain` is told for a design of so many rays."""
        return [*self.designs[name], "--rays", str(rays)]


AREA = ("--weight", "area_exponent=0.25")
TEN = ("--sensors", "10", "--layout", "density", "--gates", "ray")
CASES = {
    "face": Case(
        "Faces",
        {
            FIRST: (),
            "per-ray": ("--gates", "ray"),
            "plain": TEN,
            "importance": (*TEN, *AREA),
            "scan": ("--layout", "scan", *AREA),
        },
        (196, 361, 576),
        ("occupancy", "catalog:vl53l5cx", "catalog:azure-kinect:wide-binned"),
        "gate.width_m.max=0.12",
    ),
    "arm": Case(
        "Arm",
        {FIRST: (), "plain": ("--sensors", "8", "--layout", "distributed")},
        (400, 1000, 1200),
        ("occupancy", "no-visibility", "catalog:vl53l5cx"),
        "gate.width_m.max=0.5",
    ),
    "warehouse": Case(
        "Warehouse",
        {FIRST: (), "plain": ("--layout", "scan")},
        (6, 12, 18),
        ("occupancy", "no-visibility"),
        "gate.width_m.max=0.3",
    ),
}


@dataclass(frozen=True)
class Times:
    """What things take here [s], wall clock of whole processes.

    Arguments:
        learning: Learning the density, as the run has it.
        change: A change of a constraint of `plain`: fitting anew under it.
        chosen: The same, with chosen rays.
    """

    learning: float
    change: float
    chosen: float

    @property
    def ours(self) -> float:
        """Learning once, ten changes, and choosing rays once: what one search of `cma` is given."""
        return self.learning + CHANGES * self.change + self.chosen


def kept(path: Path, measure: Any) -> Any:
    """What a file has, measured and written where it is missing."""
    if not path.exists():
        found = measure()
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def run_of(task: str, folder: Path, options: Any) -> Path:
    """A run of a task in the folder: learned there, or copied from where `--run` says."""
    target = folder / task / "run"
    given = dict(one.split("=", 1) for one in options.run)
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        if task in given:
            shutil.copytree(given[task], target)
        else:
            settings = face_settings(options.model) if task == "face" else {}
            options.run, asked = None, options.run
            learned(task, target.parent, options, settings)
            options.run = asked
    return target


def measured_on() -> str:
    """When and on what something was measured."""
    found = machine()
    return (
        f"Measured on {datetime.date.today():%Y-%m-%d}: {found['processor']}, {found['cores']} cores, "
        f"{found['threads']} thread(s), Python {found['python']}, load {found['load_at_start']} at the start."
    )


def designs_of(case: Case, run: Path, rays: int) -> list[Path]:
    """Our designs for a number of rays, fitted where they are missing; the first of them has chosen rays."""
    found = []
    for name in case.designs:
        path = run / "designs" / f"{name}-{rays}.yaml"
        if not path.exists():
            run_process(
                lidardesign("constrain", run, "--name", path.stem, "--json", *case.words(name, rays))
            ).document()
        found.append(path)
    return found


def times_of(case: Case, run: Path, rounds: int) -> dict[str, float]:
    """What learning and a change of a constraint take, see `Times`: medians over rounds."""
    learning = json.loads((run / "manifest.json").read_text(encoding="utf-8"))["learn"]["seconds"]
    spent = {}
    rays = case.rays[len(case.rays) // 2]
    for key, name in (("change", "plain"), ("chosen", FIRST)):
        command = lidardesign("constrain", run, "--set", case.change, "--name", f"changed-{key}", "--json")
        results = [run_process([*command, *case.words(name, rays)]) for _ in range(rounds)]
        results[0].document()
        spent[key] = statistics.median(result.wall for result in results)
    return {"learning": learning, **spent}


def evaluated(designs: Sequence[Path], rays: int, baselines: Sequence[str], seconds: float | None) -> dict[str, Any]:
    """What `evaluate` prints about designs at one number of rays; without seconds nothing is searched for."""
    words: list[str | Path] = ["evaluate", *designs, "--rays", str(rays), "--json"]
    for name in baselines:
        words += ["--baseline", name]
    if seconds is not None:
        words += ["--baseline", "cma", "--cma-seconds", f"{seconds:.1f}"]
    return run_process(lidardesign(*words)).document()


def measured(task: str, options: Any) -> dict[str, Any]:
    """Everything about one task: its times, and what `evaluate` found at each number of rays."""
    case, folder = CASES[task], options.folder / task
    rays = options.rays or case.rays
    run = run_of(task, options.folder, options)
    times = kept(folder / "times.json", lambda: times_of(case, run, options.rounds))
    seconds = options.cma_seconds or Times(**times).ours
    where = kept(folder / "where.json", measured_on)
    found: dict[str, Any] = {"times": times, "seconds": seconds, "where": where, "rays": {}}
    for count in rays:
        designs = designs_of(case, run, count)
        print(f"{task}: {count} rays ...", file=sys.stderr, flush=True)
        searched = seconds if not options.cma_rays or count in options.cma_rays else None
        document = kept(
            folder / f"{count}.json", lambda d=designs, n=count, s=searched: evaluated(d, n, case.baselines, s)
        )
        longer = folder / f"{count}-long.json"
        if (options.long and searched) or longer.exists():
            held = [path for path in designs if path.stem.rpartition("-")[0] in OURS]
            again = kept(longer, lambda d=held, n=count: evaluated(d, n, (), LONG * seconds))
            document = joined(document, again)
        found["rays"][count] = named(document, count)
    return found


def named(document: dict[str, Any], count: int) -> dict[str, Any]:
    """The document with our designs by what they are, without the number of rays that they were made for."""
    text = json.dumps(document)
    for name in {name for case in CASES.values() for name in case.designs}:
        text = text.replace(f'"{name}-{count}"', f'"{name}"')
    return json.loads(text)


def joined(document: dict[str, Any], longer: dict[str, Any]) -> dict[str, Any]:
    """An evaluation with the rows of `cma` of another one, under a name of their own."""
    merged = json.loads(json.dumps(document))
    for key in ("rows", "equal_bandwidth"):
        merged[key] += [{**row, "design": LONG_NAME} for row in longer[key] if row["design"] == "cma"]
    for key in ("paired", "paired_equal_bandwidth"):
        merged[key] += [{**pair, "b": LONG_NAME} for pair in longer[key] if pair["b"] == "cma"]
    return merged


def standing(pair: Mapping[str, Any], better: str) -> str:
    """Whether `a` is better than `b` by more than the interval."""
    if pair["ci_low"] * pair["ci_high"] <= 0:
        return "not told apart"
    lower = pair["difference"] < 0
    return "better" if lower == (better == "lower") else "worse"


def told(pair: Mapping[str, Any] | None, other: float, better: str) -> str:
    """A paired difference with its interval, in percent of the other's value, and what it says."""
    if pair is None:
        return ""
    if not other:
        return standing(pair, better)
    low, middle, high = (100 * pair[key] / other for key in ("ci_low", "difference", "ci_high"))
    return f"{middle:+.1f} ({low:+.1f} to {high:+.1f}), {standing(pair, better)}"


def ours_of(found: dict[str, Any]) -> list[str]:
    """Which of our designs the rivals are held against."""
    there = {row["design"] for document in found["rays"].values() for row in document["rows"]}
    return [name for name in OURS if name in there]


def pairs_of(document: dict[str, Any], key: str) -> dict[tuple[str, str], dict[str, Any]]:
    """Differences by the names of both."""
    return {(pair["a"], pair["b"]): pair for pair in document[key]}


def equal_rays(found: dict[str, Any]) -> list[list[object]]:
    """One row per number of rays and design or rival, with how much better ours are."""
    rows = []
    for count, document in found["rays"].items():
        pairs, better = pairs_of(document, "paired"), document["metric"]["better"]
        for row in document["rows"]:
            interval = f"{row['ci_low']:.3g} to {row['ci_high']:.3g}"
            against = [told(pairs.get((name, row["design"])), row["value"], better) for name in ours_of(found)]
            rows.append([count, row["design"], row["value"], interval, row["bandwidth_mbps"], *against])
    return rows


def equal_bandwidth(found: dict[str, Any]) -> list[list[object]]:
    """One row per number of rays, design and rival in its bandwidth."""
    rows = []
    for count, document in found["rays"].items():
        better = document["metric"]["better"]
        spent = {row["design"]: row["bandwidth_mbps"] for row in document["rows"]}
        # a design may meet a rival at several numbers of its rays; here there is one
        pairs = pairs_of(document, "paired_equal_bandwidth")
        for row in document["equal_bandwidth"]:
            name = row["matched_to"]
            if name in OURS:
                against = told(pairs[name, row["design"]], row["value"], better)
                rows.append([count, name, spent[name], row["design"], row["rays"], row["value"], against])
    return rows


def searches(found: dict[str, Any]) -> list[list[object]]:
    """One row per search of `cma`."""
    return [
        [
            count,
            one["limit_mbps"] or "",
            one["parameters"],
            one["seconds"],
            one["cpu_seconds"],
            one["candidates"],
            one["evaluations"],
            one["start_value"],
            one["value"],
        ]
        for count, document in found["rays"].items()
        for one in document.get("cma", [])
    ]


def verdicts(found: dict[str, Any]) -> list[str]:
    """What is claimed of our designs, over all numbers of rays."""
    designs = set().union(*(case.designs for case in CASES.values()))
    lines = []
    for name in ours_of(found):
        for key, where in (("paired", "rays"), ("paired_equal_bandwidth", "bandwidth")):
            cases = {
                f"{count} rays, {other}": standing(pair, document["metric"]["better"]) == "better"
                for count, document in found["rays"].items()
                for (own, other), pair in pairs_of(document, key).items()
                if own == name and other not in designs
            }
            lines.append(
                verdict(f"{name} is better than every rival at equal {where}, by more than the interval", cases)
            )
    times, seconds = found["times"], found["seconds"]
    faster = {"fitting anew": seconds / times["change"] >= LEAST_FACTOR}
    return [
        *lines,
        f"a change of a constraint takes {times['change']:.2g} s, chosen rays {times['chosen']:.2g} s, and cma "
        f"{seconds:.0f} s: {seconds / times['change']:.0f} and {seconds / times['chosen']:.0f} times as long",
        verdict(f"at least {LEAST_FACTOR:g} times faster per change of a constraint than cma", faster),
    ]


def tables_of(title: str, found: dict[str, Any]) -> dict[str, tuple[list[str], list[list[object]]]]:
    """Captions, columns and rows of one task."""
    document = next(iter(found["rays"].values()))
    metric = f"{document['metric']['name']} {document['metric']['unit']}"
    scenes = f"{document['scenes']} held-out scenes"
    against = [f"{name} against it, %" for name in ours_of(found)]
    return {
        f"{title}, equal rays, {scenes}": (
            ["rays", "design", metric, "95 % interval", "Mbit/s", *against],
            equal_rays(found),
        ),
        f"{title}, equal bandwidth, {scenes}": (
            ["rays", "design", "Mbit/s", "rival", "its rays", metric, "design against it, %"],
            equal_bandwidth(found),
        ),
        f"{title}, searches of cma on training scenes": (
            ["rays", "within Mbit/s", "numbers", "s", "CPU s", "candidates", "scores", "start", "best"],
            searches(found),
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
        document = next(iter(found["rays"].values()))
        metric = document["metric"]
        for name, points in curves(found).items():
            ours = name in CASES[task].designs
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


def curves(found: dict[str, Any]) -> dict[str, dict[str, list[float]]]:
    """Rays, bandwidths and scores of each design and rival, at ascending numbers of rays."""
    lines: dict[str, dict[str, list[float]]] = {}
    for document in found["rays"].values():
        for row in document["rows"]:
            line = lines.setdefault(row["design"], {"rays": [], "bandwidth_mbps": [], "value": []})
            for key, values in line.items():
                values.append(row[key])
    return lines


def write_page(page: Path, everything: Mapping[str, dict[str, Any]]) -> None:
    """Put tables and verdicts between the marks of the tasks that were measured."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
    from fill_benchmarks import filled

    text = page.read_text(encoding="utf-8")
    for task, found in everything.items():
        parts = [
            f"**{caption}**\n\n{table(*content)}" for caption, content in tables_of(CASES[task].title, found).items()
        ]
        listed = "\n".join(textwrap.fill(f"- {line}", 120, subsequent_indent="  ") for line in verdicts(found))
        text = filled(text, task, "\n\n".join([textwrap.fill(found["where"], 120), *parts, listed]))
    page.write_text(text, encoding="utf-8")


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where runs, designs and results are kept")
    made.add_argument("--task", choices=list(CASES), action="append", help="only this task; repeatable")
    made.add_argument("--run", action="append", default=[], metavar="TASK=RUN", help="a run to copy; repeatable")
    made.add_argument("--model", default="ict", help="face model: ict, embedded, or a file (default %(default)s)")
    made.add_argument("--preset", help="what is learned (default standard)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    made.add_argument("--rays", type=int, nargs="+", help="numbers of rays (default: three of each task)")
    made.add_argument("--cma-seconds", type=float, help="of each search (default: as long as ours takes)")
    made.add_argument("--cma-rays", type=int, nargs="+", help="numbers of rays at which it searches (default: all)")
    made.add_argument("--long", action="store_true", help=f"also searches that take {LONG} times as long")
    made.add_argument("--page", type=Path, metavar="FILE.md", help="put the tables between this page's marks")
    made.add_argument("--picture", type=Path, metavar="FILE.png", help="draw scores against rays and bandwidth")
    options = made.parse_args()
    everything = {task: measured(task, options) for task in options.task or CASES}
    tables: dict[str, tuple[list[str], list[list[object]]]] = {}
    lines = []
    for task, found in everything.items():
        tables |= tables_of(CASES[task].title, found)
        lines += [f"{CASES[task].title}: {line}" for line in verdicts(found)]
    report("Rivals", tables, lines, options.json)
    if options.page is not None:
        write_page(options.page, everything)
    if options.picture is not None:
        draw(everything, options.picture)


if __name__ == "__main__":
    main()
