"""`lidardesign learn` on faces as a whole process, with an empty field cache: time, memory, and quality.

python benchmarks/learn.py                          # presets standard and draft
python benchmarks/learn.py --preset draft --set learning.steps=10 --set task.train=5
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from common import face_settings, lidardesign, model_option, parser, report, run_process


def learn(task: str, preset: str, seed: int, settings: list[str]) -> list[object]:
    """One row: seconds, memory and the figures that the command prints."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["learn", task, "--preset", preset, "--seed", str(seed), "--out", Path(folder) / "run", "--json"]
        for setting in settings:
            words += ["--set", setting]
        result = run_process(lidardesign(*words), {"LIDARDESIGN_CACHE": str(Path(folder) / "cache")})
        found = result.document()
    for phase, seconds in found["timings"].items():
        print(f"{preset}, seed {seed}: {phase} {seconds:.1f} s")
    figures = (found[key] for key in ("steps", "ess", "kl_nats", "coverage"))
    return [preset, seed, result.wall, result.cpu, result.peak_mib, *figures]


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    model_option(made)
    made.add_argument("--task", default="face")
    made.add_argument("--preset", action="append", help="repeatable (default standard and draft)")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="passed on; repeatable")
    options = made.parse_args()
    settings = list(options.set)
    if options.task == "face":
        settings += [f"{key}={value}" for key, value in face_settings(options.model).items()]
    presets = options.preset or ["standard", "draft"]
    rows = [learn(options.task, preset, seed, settings) for seed in range(options.rounds) for preset in presets]
    columns = ["preset", "seed", "wall s", "CPU s", "peak MiB", "steps", "ESS", "KL nats", "coverage"]
    report(
        f"lidardesign learn {options.task}: whole process, empty cache",
        {"One row per seed": (columns, rows)},
        path=options.json,
    )


if __name__ == "__main__":
    main()
