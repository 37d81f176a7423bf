"""Distance fields of many head meshes: built with an empty cache, and read from it.

python benchmarks/fields.py
"""

from __future__ import annotations

import os
import shutil
import statistics
import tempfile
import time
from pathlib import Path

from common import face_scenes, model_option, parser, report

from lidardesign.density.fields import TableField, build_field
from lidardesign.density.settings import DensitySettings
from lidardesign.density.target import PADDING_SIGMAS


def timed(scenes: list, resolution: int) -> tuple[float, float, TableField]:
    """Wall and processor seconds of building the field of all scenes."""
    padding_m = PADDING_SIGMAS * DensitySettings().sigma_m
    started, spent = time.perf_counter(), time.process_time()
    field = build_field(scenes, lambda body: body.is_target, resolution=resolution, padding_m=padding_m)
    return time.perf_counter() - started, time.process_time() - spent, field


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    model_option(made)
    made.add_argument("--scenes", type=int, default=50)
    made.add_argument("--resolution", type=int, default=64)
    options = made.parse_args()
    scenes = face_scenes(options.model, options.scenes)
    built, read = [], []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["LIDARDESIGN_CACHE"] = folder
        for _ in range(options.rounds):
            shutil.rmtree(Path(folder) / "fields", ignore_errors=True)
            built.append(timed(scenes, options.resolution)[:2])
            *times, field = timed(scenes, options.resolution)
            read.append(times)
    counts = " x ".join(map(str, field.grid.counts))
    rows = [
        [state, *(statistics.median(column) for column in zip(*times, strict=True))]
        for state, times in (("built, cache empty", built), ("read from the cache", read))
    ]
    faces = len(scenes[0].bodies[0].shape.faces)
    report(
        f"{options.scenes} fields of {counts} points from meshes of {faces} triangles",
        {"Medians": (["state", "wall s", "CPU s"], rows)},
        path=options.json,
    )


if __name__ == "__main__":
    main()
