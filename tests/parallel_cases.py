"""What the tests of several ranks compute, in one process or in each of several: `python parallel_cases.py FOLDER`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
import trimesh

from lidardesign.config import DensitySettings, LearningSettings, RunConfig
from lidardesign.density.learn import make_trainer
from lidardesign.density.rank_processes import join_ranks
from lidardesign.density.ranks import Ranks
from lidardesign.density.target.ranks import build_shared_target
from lidardesign.density.training.training_data import prepare_ground
from lidardesign.errors import ConfigError, NumericalError
from lidardesign.scene import Body, Box, Mesh, Receiver, Scene, Sphere, rigid
from lidardesign.space import DesignSpace
from lidardesign.task import Defaults, Metric, TaskConfig

LOW, HIGH = (0, -0.1, -0.1, -0.6, -0.4, 0.2), (0, 0.1, 0.1, 0.6, 0.4, 2.5)
SPACE = DesignSpace(LOW, HIGH)
SETTINGS = DensitySettings(sigma_m=0.05, field_resolution=16)
POINTS = 200
SCENES = 5
CASES = ("spheres", "frames", "meshes", "quadrature", "receiver", "importance")
TRAINED = ("frames", "meshes", "receiver")
STEPS = 10


def scenes_of_case(case: str) -> list[Scene]:
    """Scenes of one kind; their places differ, so that other columns matter at other points."""
    places = [np.array([1.2 + 0.1 * i, 0.12 * (i - 2), 0.05 * i]) for i in range(SCENES)]
    screen = Body(Box((0.02, 0.2, 0.2)), role="occluder", poses=rigid(translation_m=(0.7, 0.2, 0)))
    if case == "frames":
        paths = [[place + np.array([0, 0.02 * k, 0]) for k in range(1 + i)] for i, place in enumerate(places)]
        poses = [np.stack([rigid(translation_m=place) for place in path]) for path in paths]
        return [Scene((Body(Sphere(0.3), poses=one), screen)) for one in poses]
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    closed = Mesh(ball.vertices, ball.faces, sign="solid")
    opened = Mesh(ball.vertices, ball.faces[9:], sign="unsigned")
    shape = closed if case in ("meshes", "quadrature", "importance") else Sphere(0.3)
    receiver = Receiver((0.0, 0.3, 0.0), 0.0, 0.0, 1.5, 1.5, (0.1, 3.0)) if case == "receiver" else None
    shapes = [shape] * SCENES
    if case == "quadrature":  # an open surface in one scene widens the margin in all of them
        shapes[1] = opened
    if case == "importance":  # one scene counts otherwise than the rest, on one rank
        shapes[1] = Mesh(ball.vertices, ball.faces, importance=np.exp(5 * ball.vertices[:, 1]))
    bodies = [Body(one, poses=rigid(translation_m=place)) for one, place in zip(shapes, places, strict=True)]
    return [Scene((body, screen), receiver=receiver) for body in bodies]


def targets(case: str, count: int, ranks: Ranks) -> dict[str, np.ndarray]:
    """log p*, its gradient and proximity at random points, of `count` scenes and of a few drawn columns."""
    visibility = "quadrature" if case == "quadrature" else "raycast"
    target = build_shared_target(scenes_of_case(case)[:count], SPACE, SETTINGS, visibility, ranks)
    points = SPACE.sample(POINTS, np.random.default_rng(1))
    found = {"proximity": target.log_proximity(points)}
    for name, which in (("all", target), ("drawn", target.drawn(np.arange(0, count, 2)))):
        values, gradient = which.log_density_and_gradient(ranks.part(points), 0.1)
        found |= {f"{name} values": ranks.gather(values), f"{name} gradients": ranks.gather(gradient)}
        found[f"{name} plain"] = ranks.spread(which.log_density, points)
    return found


class CaseTask:
    """The scenes of a case as a task."""

    name, summary, api_version = "case", "scenes of one kind", 1
    Config = TaskConfig
    metric = Metric("hits", "-", "higher", 0.0, 0.0)
    defaults = Defaults()

    def __init__(self, case: str) -> None:
        self.case = case

    def space(self, config):
        return SPACE

    def scenes(self, config, split, seed):
        return scenes_of_case(self.case)

    def score(self, scene, returns):
        raise NotImplementedError


def gradients(case: str, dtype: str, ranks: Ranks) -> dict[str, np.ndarray]:
    """The gradient of every step of a short training, half of it along paths and half of it balancing."""
    learning = LearningSettings(
        steps=STEPS, batch=75, layers=1, hidden=12, bins=8, dtype=dtype, frames=4, balance_proposals=600
    )
    space = DesignSpace(LOW, HIGH, condition=("y_m",)) if case == "frames" else SPACE
    config = RunConfig(
        task_name="case", seed=3, preset="draft", task=TaskConfig(), space=space, density=SETTINGS, learning=learning
    )
    if not ranks.first:
        ranks.share(b"")  # the announcement that `follow` waits for
    ground = prepare_ground(CaseTask(case), config, ranks)
    trainer = make_trainer(ground, config, Path("nowhere"), torch.device("cpu"))
    found = {}
    for step in range(STEPS):
        value, ess = trainer._advance()
        parts = [p.grad.reshape(-1).numpy() for p in trainer.flow.parameters()]
        found[f"step {step}"] = np.concatenate([[value, ess], *parts])
    return found


def operations(ranks: Ranks) -> dict[str, np.ndarray]:
    """What each collective gives on ranks that bring different things."""
    own = np.arange(ranks.rank + 1.0) + 10 * ranks.rank
    found = {"gather": ranks.gather(own), "sum": ranks.sum(own[:1]), "max": ranks.max(own[:1])}
    found["share"] = np.frombuffer(ranks.share(b"first" if ranks.first else b"other"), dtype=np.uint8)
    found["mean"] = np.array([ranks.mean(own)])
    parameter = torch.nn.Parameter(torch.zeros(2))
    if ranks.rank:
        parameter.grad = torch.ones(2)
    ranks.sum_gradients([parameter], valid=True)
    found["gradients"] = parameter.grad.numpy().copy()
    ranks.sum_gradients([parameter], valid=ranks.first)
    found["invalid"] = parameter.grad.numpy().copy()
    for case in ("frames", "meshes"):
        target = build_shared_target(scenes_of_case(case), SPACE, SETTINGS, "raycast", ranks)
        points = np.full((3, 6), 0.3 if ranks.first else np.nan)
        try:
            target.log_density(points)
        except NumericalError as error:
            found[f"{case} not finite"] = np.array(str(error))
    ranks.agree("scenes", b"the same")
    try:
        ranks.agree("scenes", bytes([ranks.rank]))
    except ConfigError as error:
        found["disagreement"] = np.array(str(error))
    return found


def everything(ranks: Ranks) -> dict[str, np.ndarray]:
    """All figures by name."""
    found = {f"{case} {count} {name}": values for case in CASES for count in (SCENES, 1)
             for name, values in targets(case, count, ranks).items()}  # fmt: skip
    for case in TRAINED:
        for dtype in ("float64", "float32"):
            steps = gradients(case, dtype, ranks)
            found |= {f"{case} {dtype} {name}": values for name, values in steps.items()}
    return found


if __name__ == "__main__":
    joined = join_ranks()
    figures = {**everything(joined), **operations(joined)}
    np.savez(Path(sys.argv[1]) / f"rank-{joined.rank}.npz", **figures)
    joined.leave()
