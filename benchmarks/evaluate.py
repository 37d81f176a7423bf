"""`lidardesign evaluate` on designs of 2, 4 and 10 sensors: throughput, time by phase, and all that it found.

Numbers of workers take turns, and their rows are compared.

python benchmarks/evaluate.py [--run RUN]
"""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path
from typing import Any

from common import (
    ProcessResult,
    face_settings,
    lidardesign,
    median_ratio,
    model_option,
    parser,
    report,
    run_process,
    verdict,
)

# The phase of `evaluate` that casts rays at held-out scenes and scores what returns.
SCORING = "held-out scenes"
BASELINES = ("uniform", "random", "bounding")


def prepared(folder: Path, options: Any) -> tuple[Path, list[Path]]:
    """A run, learned where none is given, and its designs."""
    run = options.run
    if run is None:
        run = folder / "run"
        words = ["learn", "face", "--preset", options.preset, "--out", run, "--json"]
        for setting in [*options.set, *(f"{key}={value}" for key, value in face_settings(options.model).items())]:
            words += ["--set", setting]
        run_process(lidardesign(*words)).document()
    designs = []
    for sensors in options.sensors:
        name = f"benchmark-{sensors}"
        words = ["fit", run, "--sensors", str(sensors), "--name", name, "--layout", options.layout, "--json"]
        run_process(lidardesign(*words)).document()
        designs.append(run / "designs" / f"{name}.yaml")
    return run, designs


def score_rows(found: dict[str, Any]) -> list[list[object]]:
    """One row per design and budget."""
    return [
        [row["design"], row["rays"], row["value"], f"{row['ci_low']:.2f} to {row['ci_high']:.2f}", row["failures"],
         row["bandwidth_mbps"]]
        for row in sorted(found["rows"], key=lambda row: (row["rays"], row["design"]))
    ]  # fmt: skip


def paired_rows(found: dict[str, Any], key: str) -> list[list[object]]:
    """Designs against baselines, scene by scene."""
    sign = 1.0 if found["metric"]["better"] == "lower" else -1.0
    rows = []
    for pair in found[key]:
        if pair["a"] in BASELINES or pair["b"] not in BASELINES:
            continue
        low, high = pair["ci_low"], pair["ci_high"]
        decided = "better" if sign * low + sign * high < 0 else "worse"
        standing = decided if low * high > 0 else "no significant difference"
        interval = f"{low:.2f} to {high:.2f}"
        rows.append([pair["a"], pair["b"], pair["rays"], pair["difference"], interval, standing])
    return rows


def equal_bandwidth_rows(found: dict[str, Any]) -> list[list[object]]:
    """Rows at the bandwidth of another design."""
    return [
        [row["design"], row["rays"], row["value"], row["bandwidth_mbps"], f"{row['matched_to']}, {row['matched_rays']}"]
        for row in found["equal_bandwidth"]
    ]


def bandwidth_lines(found: dict[str, Any]) -> list[str]:
    """How many times less bandwidth each design needs than each baseline, at equal rays."""
    spent = {(row["design"], row["rays"]): row["bandwidth_mbps"] for row in found["rows"]}
    names = [name for name in dict.fromkeys(name for name, _ in spent) if name not in BASELINES]
    lines = []
    for name in names:
        for baseline in BASELINES:
            ratios = [
                spent[baseline, rays] / value
                for (design, rays), value in spent.items()
                if design == name and (baseline, rays) in spent
            ]
            lines.append(f"{name}: {statistics.median(ratios):.2f} times less bandwidth than {baseline} at equal rays")
    return lines


def rays_scored(found: dict[str, Any]) -> int:
    """Rays that were simulated and scored, over all designs, budgets and held-out scenes."""
    return found["scenes"] * sum(row["rays"] for row in (*found["rows"], *found["equal_bandwidth"]))


def throughput_rows(results: dict[str, list[ProcessResult]]) -> list[list[object]]:
    """One row per number of workers: medians of the whole process, rays per second, ratio to the first."""
    first, rows = next(iter(results.values())), []
    for workers, found in results.items():
        walls, cpus, peaks = zip(*((one.wall, one.cpu, one.peak_mib) for one in found), strict=True)
        scoring = [one.document()["timings"][SCORING] for one in found]
        per_second = rays_scored(found[0].document()) / statistics.median(scoring)
        faster = median_ratio([one.document()["timings"][SCORING] for one in first], scoring)
        medians = (*map(statistics.median, (walls, cpus)), max(peaks), statistics.median(scoring))
        rows.append([workers, *medians, per_second, faster])
    return rows


def phase_rows(found: dict[str, Any]) -> list[list[object]]:
    """Seconds of every phase."""
    total = sum(seconds for name, seconds in found["timings"].items() if "/" not in name)
    return [[name, seconds, 100 * seconds / total] for name, seconds in found["timings"].items()]


def same_rows(results: dict[str, list[ProcessResult]]) -> bool:
    """Whether every run found the same scores; the seconds that rows report may differ."""
    kept = [
        [{key: value for key, value in row.items() if key != "seconds"} for row in one.document()["rows"]]
        for found in results.values()
        for one in found
    ]
    return all(rows == kept[0] for rows in kept)


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    model_option(made)
    made.add_argument("--run", type=Path, help="a face run (default: learn one)")
    made.add_argument("--preset", default="standard", help="what is learned (default %(default)s)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    made.add_argument("--sensors", type=int, nargs="+", default=[2, 4, 10])
    made.add_argument("--layout", default="even", choices=["even", "chosen"])
    made.add_argument("--rays", type=int, nargs="+", default=[36, 100, 196, 361, 576])
    made.add_argument("--workers", nargs="+", default=["1", "2"], help="numbers or dask schedulers, tried in turns")
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        _, designs = prepared(Path(folder), options)
        words = ["evaluate", *designs, "--json"]
        for rays in options.rays:
            words += ["--rays", str(rays)]
        results: dict[str, list[ProcessResult]] = {workers: [] for workers in options.workers}
        for _ in range(options.rounds):
            for workers, done in results.items():
                done.append(run_process(lidardesign(*words, "--workers", workers)))
        found = results[options.workers[0]][0].document()
    unit = found["metric"]["unit"]
    tables = {
        f"Whole process, {rays_scored(found)} rays scored": (
            ["workers", "wall s", "CPU s", "peak MiB", "scoring s", "rays per s", "times as fast"],
            throughput_rows(results),
        ),
        f"Phases with {options.workers[0]} worker(s)": (["phase", "s", "%"], phase_rows(found)),
        f"Scores on {found['scenes']} held-out scenes": (
            ["design", "rays", f"{found['metric']['name']} {unit}", "95 % interval", "failures", "Mbit/s"],
            score_rows(found),
        ),
        "Paired differences at equal rays": (
            ["design", "baseline", "rays", f"difference {unit}", "95 % interval", "design is"],
            paired_rows(found, "paired"),
        ),
    }
    if found["equal_bandwidth"]:
        columns = ["design", "rays", f"{found['metric']['name']} {unit}", "Mbit/s", "of"]
        tables["At equal bandwidth"] = (columns, equal_bandwidth_rows(found))
        columns = ["design", "baseline", "design's rays", f"difference {unit}", "95 % interval", "design is"]
        tables["Paired differences at equal bandwidth"] = (columns, paired_rows(found, "paired_equal_bandwidth"))
    lines = [*bandwidth_lines(found), verdict("the same scores", {"all runs": same_rows(results)})]
    report("lidardesign evaluate: faces", tables, lines, options.json)


if __name__ == "__main__":
    main()
