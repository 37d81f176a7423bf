"""Designs side by side in streets that nobody has seen, over the same ranges, and near children: tables of README.md.

    python compare.py REFERENCE.yaml DESIGN.yaml ... [--scenes 200] [--seed 0]

Every design fires all its rays, and hears from 1 to 60 m. Intervals hold 95 % of bootstrapped means over scenes;
differences to the first design are scene by scene.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import lidardesign as ld
import numpy as np
from lidardesign import Rays
from lidardesign.simulate.returns import simulate

from lidardesign_street.scenes import OWN, scene_of, user_of
from lidardesign_street.task import FARTHEST_M, NEAREST_M, StreetTask

BOOTSTRAPS = 2000
CHILD, NUMBER = 0.6, 24  # the size of children, of that of grown-ups, and how many stand around the car
CHILDREN_M = (3, 5, 8, 12, 16, 20)


def interval(values: np.ndarray, generator: np.random.Generator) -> str:
    """The mean over scenes (S,), and what 95 % of bootstrapped means lie between."""
    means = values[generator.integers(len(values), size=(BOOTSTRAPS, len(values)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return f"{values.mean():.1f} ({low:.1f} to {high:.1f})"


def rays_of(path: Path) -> Rays:
    """All rays of a design, which hear over the ranges of the task."""
    rays = ld.load_design(path).rays()
    return replace(rays, gate_m=np.tile([NEAREST_M, FARTHEST_M], (len(rays), 1)))


def children(task: StreetTask, rays: Rays, distance_m: float) -> float:
    """The share of children that are missed who stand around the car at a distance [%]."""
    turn = 2 * np.pi * (np.arange(NUMBER) + 0.5) / NUMBER
    around = (user_of("pedestrian", *(distance_m * np.array([np.cos(a), np.sin(a)])), CHILD) for a in turn)
    scenes = [scene_of([child]) for child in around if child.is_apart(OWN)]
    return float(np.mean([task.score(scene, simulate(scene, rays)).value for scene in scenes]))


def main() -> None:
    """Print a table of all designs in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("designs", nargs="+", type=Path)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    task = StreetTask()
    scenes = task.scenes(task.Config(test=options.scenes), "test", options.seed)
    generator = np.random.default_rng(options.seed)
    reference: np.ndarray | None = None
    for path in options.designs:
        rays = rays_of(path)
        scores = [task.score(scene, simulate(scene, rays)) for scene in scenes]
        missed = np.array([[score.value, *score.details.values()] for score in scores])
        less = ""
        if reference is None:
            reference = missed[:, 0]
            heads = ("design", "points per turn", "missed [%]", f"less than {path.stem}", *scores[0].details)
            print(f"| {' | '.join(heads)} |")
            print("|---" * len(heads) + "|")
        else:
            less = interval(reference - missed[:, 0], generator)
        cells = [interval(column, generator) for column in missed.T]
        print(f"| {' | '.join((path.stem, str(len(rays)), cells[0], less, *cells[1:]))} |", flush=True)
    print(f"\n| children missed [%] | {' | '.join(f'{distance} m' for distance in CHILDREN_M)} |")
    print("|---" * (1 + len(CHILDREN_M)) + "|")
    for path in options.designs:
        missed = " | ".join(f"{children(task, rays_of(path), distance):.0f}" for distance in CHILDREN_M)
        print(f"| {path.stem} | {missed} |", flush=True)


if __name__ == "__main__":
    main()
