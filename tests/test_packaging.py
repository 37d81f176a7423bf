"""The wheel is complete: installed elsewhere, it lists its tasks and carries its data."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "lidardesign", "tasks")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """A wheel built from a copy of the sources, so that the checkout stays as it is."""
    pytest.importorskip("setuptools", minversion="77", reason="building a wheel offline needs setuptools")
    copy = tmp_path_factory.mktemp("sources")
    for name in SOURCES:
        source = ROOT / name
        if source.exists():
            subprocess.run(["cp", "-r", str(source), str(copy)], check=True)
    out = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--no-build-isolation", "--no-deps", "--wheel-dir", str(out), str(copy))
    (path,) = out.glob("lidardesign-*.whl")
    return path


def pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", *arguments]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """A folder outside the repository that the wheel is installed into."""
    target = tmp_path_factory.mktemp("installed")
    pip("install", "--no-deps", "--target", str(target), str(wheel))
    return target


def run_installed(installed: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    code = (
        "import sys, lidardesign, lidardesign_tasks\n"
        f"assert lidardesign.__file__.startswith({str(installed)!r}), lidardesign.__file__\n"
        f"assert lidardesign_tasks.__file__.startswith({str(installed)!r}), lidardesign_tasks.__file__\n"
        f"from lidardesign.cli.main import run\nrun({list(arguments)!r})"
    )
    command = [sys.executable, "-c", code]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


def test_the_wheel_holds_every_module_and_data_file_and_no_tests(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {path.relative_to(ROOT).as_posix() for path in (ROOT / "lidardesign").rglob("*.py")}
    expected |= {path.relative_to(ROOT / "tasks").as_posix() for path in (ROOT / "tasks").rglob("*.py")}
    expected |= {"lidardesign/py.typed", "lidardesign/design/design.schema.json"}
    expected |= {path.relative_to(ROOT).as_posix() for path in (ROOT / "lidardesign").rglob("*.yaml")}
    expected |= {path.relative_to(ROOT).as_posix() for path in (ROOT / "lidardesign").rglob("template/*.txt")}
    data = ROOT / "tasks" / "lidardesign_tasks" / "data"
    expected |= {path.relative_to(ROOT / "tasks").as_posix() for path in data.iterdir() if path.is_file()}
    assert expected <= names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "examples/"))]


def test_the_installed_wheel_lists_its_tasks_from_outside_the_repository(installed, tmp_path):
    result = run_installed(installed, tmp_path, "tasks", "list")
    assert result.returncode == 0, result.stderr
    for name in ("arm", "emitter", "face", "flatland", "meshes", "mujoco", "warehouse"):
        assert name in result.stdout
    assert "broken" not in result.stdout, result.stdout


def test_the_installed_wheel_shows_a_task_and_its_formats(installed, tmp_path):
    assert '"metric"' in run_installed(installed, tmp_path, "tasks", "show", "face", "--json").stdout
    assert "csv" in run_installed(installed, tmp_path, "export", "--list").stdout
