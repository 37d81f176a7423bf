"""`lidardesign evaluate` on designs of 2, 4 and 10 sensors: time of the whole process, and all that it found.

python benchmarks/evaluate.py [--run RUN]
"""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path
from typing import Any

from common import face_settings, lidardesign, model_option, parser, report, run_process

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
        standing = decided if low * high > 0 else "not told apart"
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


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    model_option(made)
    made.add_argument("--run", type=Path, help="a face run (default: learn one)")
    made.add_argument("--preset", default="standard", help="what is learned (default %(default)s)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    made.add_argument("--sensors", type=int, nargs="+", default=[2, 4, 10])
    made.add_argument("--layout", default="grid", choices=["grid", "density", "distributed"])
    made.add_argument("--rays", type=int, nargs="+", default=[36, 100, 196, 361, 576])
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        _, designs = prepared(Path(folder), options)
        words = ["evaluate", *designs, "--json"]
        for rays in options.rays:
            words += ["--rays", str(rays)]
        results = [run_process(lidardesign(*words)) for _ in range(options.rounds)]
        found = results[0].document()
    unit = found["metric"]["unit"]
    tables = {
        "Whole process": (["wall s", "CPU s", "peak MiB"], [[one.wall, one.cpu, one.peak_mib] for one in results]),
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
    report("lidardesign evaluate: faces", tables, bandwidth_lines(found), options.json)


if __name__ == "__main__":
    main()
