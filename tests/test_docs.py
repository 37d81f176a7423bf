"""What the README shows is true."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from lidardesign import registry
from lidardesign.cli.main import app
from lidardesign.design.constraints import Constraints
from lidardesign.errors import LidardesignError
from lidardesign.registry import load_task
from lidardesign.run.config import resolve
from lidardesign.run.yaml import parse_yaml
from lidardesign.scene import Scene
from lidardesign.simulate.returns import Rays
from lidardesign.simulate.simulate import simulate
from lidardesign.task import Task

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_constraint_file_is_accepted():
    text = next(block for block in blocks("yaml") if "buyable" in block)
    constraints = Constraints.from_mapping(parse_yaml(text, where="README").value)
    assert constraints.budget.rays == 576


def test_every_constraint_key_that_is_shown_is_accepted_and_none_is_left_out():
    text = next(block for block in blocks("yaml") if "each:" in block)
    shown = parse_yaml(text, where="README").value
    Constraints.from_mapping(shown)
    for section, model in Constraints.model_fields.items():
        assert section in shown
        keys = getattr(model.annotation, "model_fields", {})
        assert all(key in text for key in keys)


def test_the_configuration_file_is_accepted(tmp_path):
    text = next(block for block in blocks("yaml") if "scans.yaml" in block)
    path = tmp_path / "scans.yaml"
    path.write_text(text)
    with pytest.raises(LidardesignError, match=r"scans: is not a folder") as caught:
        resolve(load_task("meshes"), config_file=path)
    assert caught.value.exit_code == 3


def test_every_exit_code_of_the_error_tree_is_listed():
    def codes(kind):
        yield kind.exit_code
        for child in kind.__subclasses__():
            yield from codes(child)

    listed = {int(number) for row in re.findall(r"^\| ([\d, ]+) \|", README, re.MULTILINE) for number in row.split(",")}
    assert {0, 70, 130, 141, 143} | set(codes(LidardesignError)) == listed


def test_every_command_is_shown():
    for command in app.registered_commands:
        name = command.callback.__name__
        assert name in README


def test_the_example_task_keeps_the_contract_and_scores_a_ray():
    namespace: dict[str, object] = {}
    exec(blocks("python")[0], namespace)  # the README's own text
    task = namespace["RoverTask"]()
    registry._check("rover", task)
    assert isinstance(task, Task)
    config = task.Config()
    scene = task.scenes(config, "test", 0)[0]
    assert isinstance(scene, Scene)
    origin = np.array([[0.0, 0.0, 0.3]])
    offset = scene.bodies[0].pose()[:3, 3] - origin
    rays = Rays(origin, offset / np.linalg.norm(offset), np.array([[0.1, 5.0]]), np.zeros(1), np.zeros(1))
    assert task.score(scene, simulate(scene, rays)).value == 0.0
    away = Rays(origin, -rays.direction, rays.gate_m, rays.sensor, rays.time_s)
    assert task.score(scene, simulate(scene, away)).value == 100.0
    assert resolve(task).space == task.space(config)
