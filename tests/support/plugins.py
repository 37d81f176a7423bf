"""Installing task plugins for tests: a folder on the path with packages and their entry points."""

from __future__ import annotations

import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

# A small whole task that keeps the contract; broken ones are made of it by replacing words.
GOOD = """
import numpy as np
from lidardesign.scenes.scene import Body, Scene, Sphere, rigid
from lidardesign.space import DesignSpace
from lidardesign.task import Defaults, Metric, Score, TaskConfig, random_generator


class Task:
    name = "NAME"
    summary = "how much of a ball is seen"
    api_version = 1
    Config = TaskConfig
    metric = Metric("radius error", "mm", "lower", worst=100.0, tolerance=0.5)
    defaults = Defaults(density={"sigma_m": 0.05})

    def space(self, config):
        return DesignSpace(low=(0, 0, 0, -0.5, -0.4, 0.1), high=(0, 0, 0, 0.5, 0.4, 4.0))

    def scenes(self, config, split, seed):
        return [self.scene(random_generator(seed, self.name, split, i), f"{split} {i}") for i in range(2)]

    def scene(self, generator, name):
        centre = np.array([generator.uniform(2.0, 3.0), generator.uniform(-0.5, 0.5), 0.0])
        return Scene((Body(Sphere(0.3), "ball", "target", rigid(translation_m=centre)),), name, truth={"at": centre})

    def score(self, scene, returns):
        points = np.concatenate([one.points_m for one in returns])
        if len(points) == 0:
            return Score(self.metric.worst, failed=True)
        off = np.abs(np.linalg.norm(points - scene.truth["at"], axis=1) - 0.3).mean()
        return Score(min(1000 * off + 50 / len(points), 100.0))
"""


def check_entry_points(kind, package, is_plugin, tried=None):
    """All plugins of this kind in a package are entry points, and no others are; all of them, or some, are tried."""
    homes = {}
    for path in Path(package.__file__).parent.glob("*.py"):
        name = f"{package.__name__}.{path.stem}"
        for key, value in vars(import_module(name)).items() if path.stem != "__init__" else ():
            homes |= {value.name: f"{name}:{key}"} if is_plugin(key, value) else {}
    settings = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert homes
    assert settings["project"]["entry-points"][kind.group] == homes
    named = settings["tool"]["pytest"]["ini_options"][kind.group.replace(".", "_")]
    assert sorted(named) == sorted(name for name in homes if tried is None or tried(name))
    assert [name for name in kind.names() if kind.is_shipped(name)] == sorted(homes)


def install_plugins(
    place: Path, sources: dict[str, str], package: str = "plugins", module: str = "", group: str = "lidardesign.tasks"
) -> None:
    """Install a package of plugins by name into a folder that is on the path.

    Arguments:
        place: The folder.
        sources: Python by the name of the entry point; NAME in it becomes that name.
        package: Its name.
        module: What its modules' names begin with; by default the package's name.
        group: The entry-point group.
    """
    made = place / f"{package}-1.0.dist-info"
    made.mkdir(parents=True)
    (made / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    prefix = module or package
    kind = "Task" if group == "lidardesign.tasks" else "Plugin"
    lines = [f"{name} = {prefix}_{name}:{kind}" for name in sources]
    (made / "entry_points.txt").write_text("\n".join([f"[{group}]", *lines, ""]))
    for name, source in sources.items():
        (place / f"{prefix}_{name}.py").write_text(source.replace("NAME", name))


def install_fixture(noun):
    """A fixture that installs formats or methods of another package by name, and forgets them at the end."""
    module = f"hard_{noun}s"

    @pytest.fixture
    def install(tmp_path, monkeypatch):
        place = tmp_path / "installed"
        monkeypatch.syspath_prepend(place)
        yield lambda sources: install_plugins(place, sources, module=module, group=f"lidardesign.{noun}s")
        for name in [name for name in sys.modules if name.startswith(module)]:
            del sys.modules[name]

    return install
