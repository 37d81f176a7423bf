"""What the README and the pages show is true."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np
import pytest

from lidardesign.config import resolve
from lidardesign.constraints.document import Constraints
from lidardesign.contract import check_task
from lidardesign.errors import LidardesignError
from lidardesign.run.yaml import parse_yaml
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.returns import simulate
from lidardesign.space import DesignSpace
from lidardesign.task import Task, check_interface, conditions_of, load_task

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text(encoding="utf-8")
CONSTRAINTS = (DOCS / "constraints.md").read_text(encoding="utf-8")
SHELL = (DOCS / "shell.md").read_text(encoding="utf-8")
FIRST_TASK = (DOCS / "first-task.md").read_text(encoding="utf-8")
WRITING_METHODS = (DOCS / "writing-methods.md").read_text(encoding="utf-8")
WRITING_TASKS = (DOCS / "writing-tasks.md").read_text(encoding="utf-8")
# The README's pictures are downloaded by everyone who clones it.
LARGEST_PICTURE_BYTES = 250_000
# A first page is read to its end; what else there is to say has pages of its own.
MOST_LINES = 120
# All pages together: what nobody reads helps nobody.
MOST_WORDS = 35_000


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def yaml_of(page: str, name: str) -> str:
    """The file that a page shows under a name."""
    return next(block for block in blocks("yaml", page) if block.startswith(f"# {name}"))


def constraints_of(page: str, name: str) -> Constraints:
    text = yaml_of((ROOT / page).read_text(encoding="utf-8"), name)
    return Constraints.from_mapping(parse_yaml(text, where=page).value)


def test_the_constraint_files_and_mounts_that_are_shown_are_accepted():
    assert constraints_of("docs/constraints.md", "buyable.yaml").field_of_view.horizontal_deg.max == 20
    for page in ("docs/arm.md", "docs/constraints.md"):
        ceiling = constraints_of(page, "ceiling.yaml")
        assert len(ceiling.origin.mounts_m or ()) == 9
        assert ceiling.sensors.count == 4
    (shown,) = re.findall(r"# (mounts_m: \[.*?\]\])", CONSTRAINTS)
    origin = parse_yaml(shown, where="constraints.md").value
    assert len(Constraints.from_mapping({"origin": origin}).origin.mounts_m or ()) == 2


def leaves_of(model, path=()):
    """The paths of all keys of a model, as `gate.width_m.max`."""
    for name, field in model.model_fields.items():
        kinds = (field.annotation, *get_args(field.annotation))
        inner = next((kind for kind in kinds if hasattr(kind, "model_fields")), None)
        if inner is None or name == "parts":
            yield (*path, name)
        else:
            yield from leaves_of(inner, (*path, name))


def test_every_constraint_key_that_is_shown_is_accepted_and_none_is_left_out():
    text = yaml_of(CONSTRAINTS, "every_key.yaml")
    shown = parse_yaml(text, where="constraints.md").value
    Constraints.from_mapping(shown)
    table = CONSTRAINTS.rpartition("```")[2]  # what stands behind the example
    for path in leaves_of(Constraints):
        assert path[0] in shown
        # bounds of one quantity share a row and an example
        named = [part for part in path if part not in ("min", "max")]
        assert all(part in text for part in named), path
        assert ".".join(named) in table or named[-1] in table, path


def test_the_configuration_file_is_accepted(tmp_path):
    path = tmp_path / "scans.yaml"
    path.write_text(yaml_of((DOCS / "run-folder.md").read_text(encoding="utf-8"), "scans.yaml"))
    with pytest.raises(LidardesignError, match=r"scans: is not a folder") as caught:
        resolve(load_task("meshes"), config_file=path)
    assert caught.value.exit_code == 3


def test_every_exit_code_of_the_error_tree_is_listed():
    def codes(kind):
        yield kind.exit_code
        for child in kind.__subclasses__():
            yield from codes(child)

    listed = {int(number) for row in re.findall(r"^\| ([\d, ]+) \|", SHELL, re.MULTILINE) for number in row.split(",")}
    assert {0, 70, 130, 141, 143} | set(codes(LidardesignError)) == listed


def test_the_readme_is_short():
    assert len(README.splitlines()) <= MOST_LINES


def test_the_documentation_is_short():
    # dated protocols of long runs are evidence
    pages = [page for page in DOCS.rglob("*.md") if page.parent == DOCS or page.name == "README.md"]
    assert len(README.split()) + sum(len(page.read_text("utf-8").split()) for page in pages) <= MOST_WORDS


def test_every_page_is_in_the_navigation():
    listed = re.findall(r": ([\w-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert {page.name for page in DOCS.glob("*.md")} | {"index.md"} == set(listed)


def test_the_example_task_keeps_the_contract_and_scores_a_ray():
    namespace: dict[str, object] = {}
    exec(blocks("python", FIRST_TASK)[0], namespace)  # the page's own text
    task = namespace["RoverTask"]()
    check_interface("rover", task)
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


def task_of_the_guide(name: str, block: int, **names: object):
    """A task of docs/writing-tasks.md."""
    namespace = names
    exec(blocks("python", WRITING_TASKS)[block], namespace)  # the page's own text
    return namespace[name]()


def rays_at(points: np.ndarray, origin: np.ndarray) -> Rays:
    """One ray from an origin (3,) to each point (N, 3), listening all the way."""
    offset = points - origin
    directions = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    count = len(points)
    origins = np.broadcast_to(origin, points.shape)
    return Rays(origins, directions, np.tile([0.1, 9.0], (count, 1)), np.zeros(count), np.zeros(count))


def test_the_moving_ball_of_the_guide_is_scored_over_its_frames():
    task = task_of_the_guide("PassingTask", 0)
    check_interface(task.name, task)
    config = task.Config()
    scene, again = (task.scenes(config, "test", 0)[0] for _ in range(2))
    for one, other in zip(scene.bodies, again.bodies, strict=True):
        assert np.array_equal(one.poses, other.poses)
    assert resolve(task).space == task.space(config)
    origin, ball = np.array([0.0, 0.0, 0.3]), scene.bodies[0]
    assert scene.frames == config.frames
    seen_at_the_ends = rays_at(ball.poses[[0, -1], :3, 3], origin)
    assert 0.0 < task.score(scene, simulate(scene, seen_at_the_ends)).value < 100.0
    everywhere = rays_at(ball.poses[:, :3, 3], origin)
    assert (
        task.score(scene, simulate(scene, everywhere)).value
        < task.score(scene, simulate(scene, seen_at_the_ends)).value
    )


def test_the_positions_of_the_guide_lie_in_its_space():
    task = task_of_the_guide("DriveTask", 1, DesignSpace=DesignSpace)
    assert len(conditions_of(task, None, task.space(None))) == 4


def test_the_guide_shows_the_short_method_and_format_of_the_example_package():
    package = ROOT / "examples" / "third_party" / "lidardesign_landing"
    for name in ("fibonacci", "vtk"):
        code = (package / f"{name}.py").read_text(encoding="utf-8")
        assert code in blocks("python", WRITING_METHODS)
        assert len(code.splitlines()) <= 35


def test_the_distance_of_the_guide_is_learned_and_keeps_every_law(monkeypatch):
    passing, distance = ModuleType("my_tasks.passing"), {"__name__": "__main__"}
    exec(blocks("python", WRITING_TASKS)[0], vars(passing))  # the page's own text
    monkeypatch.setitem(sys.modules, "my_tasks", ModuleType("my_tasks"))
    monkeypatch.setitem(sys.modules, "my_tasks.passing", passing)
    exec(blocks("python", WRITING_TASKS)[2], distance)
    kept = {one.law: one for one in check_task(distance["DistanceTask"]())}
    assert {law for law, one in kept.items() if one.outcome == "skip"} == {
        "conditions lie in the space", "scenes repeat elsewhere", "order does not matter",
    }  # fmt: skip
    assert "prepare_s" in kept["within time"].figures
    assert kept["best on the truth"].figures["dense"] < 5.0


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda p: p.name)
def test_links_lead_somewhere_and_pictures_are_small(page):
    targets = re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))
    for target in targets:
        found = page.parent / target
        assert found.exists(), target
        assert found.suffix != ".png" or found.stat().st_size < LARGEST_PICTURE_BYTES
