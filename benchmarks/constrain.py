"""`lidardesign constrain` as a whole process over constraint sets of every kind, against learning again.

The run has its origin free in a box of 10 cm, so that origins can be pinned; it is learned first, with the preset
that is named, unless one is given. Without `constrain`, another set of constraints would take learning again and a fit,
which is measured with the run's own settings and its fields in the cache. `lidardesign --help` is timed as well.

    python benchmarks/constrain.py [--run RUN]
"""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path

from common import ProcessResult, face_settings, lidardesign, median_ratio, model_option, parser, report, run_process

# What a change of a constraint takes is the fit; choosing rays on scenes takes longer, whatever the constraints.
EVEN = ("--layout", "even")
SETS: dict[str, tuple[str, ...]] = {
    "none": (),
    "field of view 20 deg": ("field_of_view.horizontal_deg.max=20", "field_of_view.vertical_deg.max=20"),
    "gate 0.10 m": ("gate.width_m.max=0.10",),
    "field of view and gate": (
        "field_of_view.horizontal_deg.max=20",
        "field_of_view.vertical_deg.max=20",
        "gate.width_m.max=0.10",
    ),
    "10 sensors": ("sensors.count=10",),
    "gate from 0.30 to 0.55 m": ("gate.start_m.min=0.30", "gate.end_m.max=0.55"),
    "bandwidth 1 Mbit/s": ("budget.bandwidth_mbps=1.0", "gate.width_m.max=0.15"),
    "regions of 1 cm": ("origin.spread_m.max=0.01",),
    "origin pinned": ("origin.fixed_m=[0.40, 0.0, 0.0]",),
    "origin pinned, gate and view": (
        "origin.fixed_m=[0.42, 0.02, -0.03]",
        "gate.width_m.max=0.10",
        "field_of_view.horizontal_deg.max=20",
    ),
    "576 rays, 6 sensors": ("budget.rays=576", "sensors.count=6"),
}


def constrain(run: Path, name: str) -> ProcessResult:
    """One whole process."""
    own = SETS[name]
    settings = own if any(one.startswith("sensors.count") for one in own) else ("sensors.count=4", *own)
    words = [word for setting in settings for word in ("--set", setting)]
    return run_process(lidardesign("constrain", run, *EVEN, *words, "--json", "--name", "benchmark"))


def again(run: Path, folder: Path) -> dict[str, ProcessResult]:
    """Learning with the settings of a run once more, and a fit."""
    from lidardesign.run.yaml import dump_yaml, load_yaml

    recorded = load_yaml(run / "config.yaml").value
    settings = folder / "again.yaml"
    sections = {name: recorded[name] for name in ("task", "space", "density", "learning")}
    settings.write_text(dump_yaml(sections), encoding="utf-8")
    words = ["learn", recorded["task_name"], "--config", settings, "--seed", str(recorded["seed"])]
    words += ["--preset", recorded["preset"], "--out", folder / "again", "--json"]
    found = {"learn again": run_process(lidardesign(*words))}
    words = ["fit", folder / "again", *EVEN, "--sensors", "4", "--name", "benchmark", "--json"]
    found["fit"] = run_process(lidardesign(*words))
    return found


def learned(folder: Path, preset: str, model: str, settings: list[str]) -> Path:
    """A run with a free origin."""
    words = ["learn", "face", "--preset", preset, "--set", "origin_box_m=0.05", "--out", folder / "run", "--json"]
    for setting in [*settings, *(f"{key}={value}" for key, value in face_settings(model).items())]:
        words += ["--set", setting]
    run_process(lidardesign(*words)).document()
    return folder / "run"


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=3)
    model_option(made)
    made.add_argument("--run", type=Path, help="a face run with origin_box_m above 0")
    made.add_argument("--preset", default="draft", help="what is learned where no run is given (default %(default)s)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed to learn; repeatable")
    made.add_argument("--only", action="append", choices=list(SETS), help="only this set; repeatable")
    options = made.parse_args()
    names = options.only or list(SETS)
    with tempfile.TemporaryDirectory() as folder:
        run = options.run or learned(Path(folder), options.preset, options.model, options.set)
        results = {name: [constrain(run, name) for _ in range(options.rounds)] for name in names}
        anew = again(run, Path(folder))
    helps = [run_process(lidardesign("--help")) for _ in range(options.rounds)]
    rows = []
    for name, found in results.items():
        if found[0].code == 4:
            answer, ess = "refused (exit 4)", float("nan")
        else:
            document = found[0].document()
            answer, ess = f"satisfied: {document['satisfied']}", document["ess"]
        walls, cpus, peaks = zip(*((one.wall, one.cpu, one.peak_mib) for one in found), strict=True)
        rows.append([name, *map(statistics.median, (walls, cpus)), max(peaks), answer, ess])
    renewed = anew["learn again"].document()
    for name, one in anew.items():
        rows.append([name, one.wall, one.cpu, one.peak_mib, "", renewed["ess"] if name == "learn again" else ""])
    everything = [one.wall for found in results.values() for one in found]
    renewal = sum(one.wall for one in anew.values())
    cpu = [one.cpu for found in results.values() for one in found]
    report(
        "lidardesign constrain: whole processes",
        {"Medians": (["constraints", "wall s", "CPU s", "peak MiB", "answer", "ESS"], rows)},
        [
            f"constrain: median {statistics.median(everything):.2f} s, slowest {max(everything):.2f} s",
            f"learning again and fitting: {renewal:.1f} s (fields {renewed['timings'].get('fields', 0.0):.1f} s), "
            f"{renewal / statistics.median(everything):.0f} times the median, {renewal / max(everything):.0f} times "
            "the slowest",
            f"--help: median {statistics.median(one.wall for one in helps):.2f} s",
            f"CPU / wall: {median_ratio(cpu, everything):.2f} (below 1: the machine was shared)",
        ],
        options.json,
    )


if __name__ == "__main__":
    main()
