"""What physics costs: planning where nothing is called for, each effect alone, and all of them on many rays.

python benchmarks/effects.py [--heads 10] [--rays 576] [--many 100000]
"""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from typing import Any

from common import face_scenes, interleaved, median_ratio, model_option, parser, report

MILLIMETRES = 1000.0


def even_rays(count: int, gate_m: tuple[float, float]) -> Any:
    """An even grid of rays at a face from 0.40 m."""
    import numpy as np

    from lidardesign.scenes.rays import Rays
    from lidardesign.space import direction

    side = int(np.ceil(np.sqrt(count)))
    places = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:count] + 0.5) / side
    angles = np.radians(40.0) * (places - 0.5)
    looking = direction(np.pi + angles[:, 0], angles[:, 1])
    origins = np.broadcast_to([0.40, 0.0, 0.0], looking.shape)
    gates = np.broadcast_to(gate_m, (count, 2))
    return Rays(origins, looking, gates, np.zeros(count), np.arange(count) / (count * 10.0))


def planning(scenes: list[Any], rays: Any, rounds: int) -> tuple[list[list[object]], float]:
    """Time to plan beside the time to cast and score, with the detector `ideal`."""
    from lidardesign_tasks.face import FaceTask

    from lidardesign.simulate.plan import Planner
    from lidardesign.simulate.returns import build_casters, simulate

    planner, task = Planner(), FaceTask()

    def score() -> None:
        for scene in scenes:
            task.score(scene, simulate(scene, rays, casters=build_casters(scene)))

    def plan() -> None:
        for scene in scenes:
            planner.plan(scene, [rays])

    found = interleaved({"plan": plan, "score": score}, rounds)
    share = median_ratio(found["plan"].wall, found["score"].wall)
    rows = [[name, 1000 * timing.wall_median / len(scenes)] for name, timing in found.items()]
    return [*rows, ["plan / score [%]", 100 * share]], share


def troubled(scene: Any) -> Any:
    """A scene that calls for every effect: sunlight, fog, gloss, and a head that moves."""
    from lidardesign.scenes.scene import Ambient, Medium

    bodies = tuple(
        replace(body, reflectance=0.4, specular=0.1, transmission=0.05, velocity_m_s=(0.3, 0.0, 0.0))
        for body in scene.bodies
    )
    return replace(scene, bodies=bodies, ambient=Ambient(100_000.0, "sun"), medium=Medium(0.1, 0.005))


def effects_here() -> list[str]:
    """All effects that can be simulated without a light-transport simulator."""
    from lidardesign.simulate.detector.physics import EFFECTS

    return [name for name in EFFECTS if name not in ("multipath", "shadowing")]


def by_effect(scenes: list[Any], rays: Any, detector: Any, rounds: int) -> list[list[object]]:
    """Time per scene of each effect alone and of all."""
    from lidardesign.simulate.detector.physics import Physics
    from lidardesign.simulate.returns import build_casters, simulate

    names = effects_here()
    casters = {id(scene): build_casters(scene) for scene in scenes}

    def run(effects: frozenset[str]) -> Any:
        def simulated() -> None:
            for scene in scenes:
                physics = Physics(detector, effects) if effects else None
                simulate(scene, rays, casters=casters[id(scene)], physics=physics)

        return simulated

    contestants = {"none": run(frozenset())}
    contestants |= {name: run(frozenset({name})) for name in names}
    contestants["all"] = run(frozenset(names))
    found = interleaved(contestants, rounds)
    return [
        [name, 1000 * timing.wall_median / len(scenes), median_ratio(timing.wall, found["none"].wall)]
        for name, timing in found.items()
    ]


def many(scene: Any, count: int, detector: Any, gates: dict[str, tuple[float, float]]) -> list[list[object]]:
    """Seconds for many rays with all effects on."""
    from lidardesign.simulate.detector.physics import Physics
    from lidardesign.simulate.returns import build_casters, simulate

    casters, rows = build_casters(scene), []
    for name, gate_m in gates.items():
        rays, times = even_rays(count, gate_m), []
        for _ in range(3):
            started = time.perf_counter()
            physics = Physics(detector, frozenset(effects_here()))
            (returns,) = simulate(scene, rays, casters=casters, physics=physics)
            times.append(time.perf_counter() - started)
        rows.append([name, count, statistics.median(times), float(returns.returned.mean())])
    return rows


def main() -> None:
    """Measure and print."""
    options_of = parser(__doc__, rounds=5)
    model_option(options_of)
    options_of.add_argument("--heads", type=int, default=10, help="scenes (default %(default)s)")
    options_of.add_argument("--rays", type=int, default=576, help="rays (default %(default)s)")
    options_of.add_argument("--many", type=int, default=100_000, help="rays of the largest list (default %(default)s)")
    options_of.add_argument("--detector", default="single-photon", help="detector (default %(default)s)")
    options = options_of.parse_args()
    from lidardesign.simulate.detector.files import load_detector

    detector = load_detector(options.detector)
    # a beam with a width, so that its effect has work to do
    wide = replace(detector, divergence_rad=max(detector.divergence_rad, 0.002), footprint_rays=16)
    heads = face_scenes(options.model, options.heads)
    rays = even_rays(options.rays, (0.05, 1.05))
    plan_rows, share = planning(heads, rays, options.rounds)
    hard = [troubled(scene) for scene in heads]
    effect_rows = by_effect(hard, rays, wide, options.rounds)
    gates = {"0.1 m": (0.38, 0.48), "1 m": (0.05, 1.05), "5 m": (0.05, 5.05)}
    many_rows = many(hard[0], options.many, wide, gates)
    report(
        "Effects",
        {
            "Planning with the detector ideal, per scene": (["what", "ms"], plan_rows),
            f"{options.rays} rays of 16 sub-rays, gates of 1 m, per scene": (
                ["effects", "ms", "times none"],
                effect_rows,
            ),
            "All effects on many rays": (["gate", "rays", "s", "returned"], many_rows),
        },
        [
            f"planning takes {100 * share:.2f} % of the time to cast and score",
            f"all effects on {options.many} rays: {max(row[2] for row in many_rows):.2f} s at most",
        ],
        options.json,
    )


if __name__ == "__main__":
    from common import without_traceback

    without_traceback(main)
