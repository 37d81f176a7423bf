"""What the density adds to choosing rays: with few training heads, and with origins that are free in a box.

For each seed and number of training heads a folder of heads is a task `meshes`; for each seed faces are learned with
origins in a box. A design with a gate per ray stands beside `greedy`, the same choice from even candidates, in the same
bandwidth. In the box rays of `greedy` start anywhere, those of a design at one place each, or all over regions.
What was measured is kept in the folder.

    python benchmarks/few_scenes.py --folder few
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from common import face_scenes, lidardesign, parser, report, run_process
from robots import REGIONS

RAYS = "361"
HELD_OUT, HELD_OUT_SEED = 40, 2026
FEW = (5, 10, 20)  # training heads
BOX_M = 0.15  # half the side of the box of origins


def measured(
    run: Path, task: str, settings: Mapping[str, object], seed: int, name: str = "places", bounds: Sequence[str] = ()
) -> dict[str, Any]:
    """What `evaluate` prints of a design within bounds, of a run that is learned with some settings where it is not."""
    path = run.with_name(f"{run.name}-{name}.json")
    if not path.exists():
        words = [word for key, value in settings.items() for word in ("--set", f"{key}={value}")]
        learn = ("learn", task, "--preset", "draft", "--seed", str(seed), "--out", run, *words)
        usual = ("--name", name, "--gates", "ray", "--sensors", "4", "--rays", RAYS)
        fit = ("constrain" if bounds else "fit", run, *bounds, *usual)
        evaluate = ("evaluate", run, "--designs", name, "--rays", RAYS, "--scenes-seed", str(HELD_OUT_SEED))
        for command in (fit, evaluate) if run.exists() else (learn, fit, evaluate):
            document = run_process(lidardesign(*command, "--json")).document()
        path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return json.loads(path.read_text(encoding="utf-8"))


def folder_of_heads(folder: Path, train: int, seed: int) -> dict[str, object]:
    """Keys of the task `meshes` for a folder of heads, so many of them for training."""
    import trimesh

    folder.mkdir(exist_ok=True)
    for number, scene in enumerate(face_scenes("embedded", train + HELD_OUT, seed=1000 * seed + train)):
        mesh = scene.bodies[0].shape.transformed(scene.bodies[0].pose())
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(folder / f"head{number:03}.ply")
    return {
        "folder": folder,
        "origin_m": "[0.4,0,0]",
        "centre": "false",
        "test_share": HELD_OUT / (train + HELD_OUT),
        "jitter_rotation_deg": 3,
        "jitter_translation_m": 0.005,
    }


def row(found: Mapping[str, Any], label: str, seed: int) -> list[object]:
    """The design beside `greedy`, in the same bandwidth."""
    ours = found["rows"][0]
    pair = next(one for one in found["paired_equal_bandwidth"] if (one["a"], one["b"]) == (ours["design"], "greedy"))
    difference = f"{pair['difference']:+.2f} ({pair['ci_low']:+.2f} to {pair['ci_high']:+.2f})"
    return [label, seed, ours["value"], ours["bandwidth_mbps"], difference]


def main() -> None:
    """Measure what is missing, and print everything."""
    made = parser(__doc__, rounds=1)
    made.add_argument("--folder", type=Path, required=True, help="where heads, runs and results are kept")
    made.add_argument("--seeds", type=int, default=3, help="how many runs are learned (default %(default)s)")
    options = made.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in range(options.seeds):
        for count in FEW:
            settings = folder_of_heads(options.folder / f"heads-{count}-{seed}", count, seed)
            found = measured(options.folder / f"few-{count}-{seed}", "meshes", settings, seed)
            rows.append(row(found, f"{count} training heads", seed))
    for seed in range(options.seeds):
        settings = {"origin_box_m": BOX_M, "train": 200}
        for name, bounds in (("places", ()), ("regions", ("--set", REGIONS))):
            found = measured(options.folder / f"box-{seed}", "face", settings, seed, name, bounds)
            rows.append(row(found, f"a box of origins, {name}", seed))
    columns = ["faces", "seed", "design mm", "Mbit/s", "design minus greedy, mm"]
    report(
        "What the density adds to choosing rays", {f"{RAYS} rays, equal bandwidth": (columns, rows)}, [], options.json
    )


if __name__ == "__main__":
    main()
