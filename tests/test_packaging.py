"""Sdist and wheel are complete: the sdist runs its tests, and a wheel built from it, installed elsewhere, lists its
tasks, carries its data and names pages of the documentation that can be opened. Files for continuous integration
install it from wherever it is."""

from __future__ import annotations

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.specifiers import SpecifierSet

from lidardesign.contract.scaffold import new_task

ROOT = Path(__file__).parents[1]
# All that a checkout has.
FOLDERS = ("benchmarks", "docs", "examples", "lidardesign", "tasks", "tests", "tools")
FILES = (
    "CHANGELOG.md", "LICENSE", "MANIFEST.in", "Makefile", "README.md", "constraints.txt", "mkdocs.yml",
    "pyproject.toml",
)  # fmt: skip
PAGES = Path("share", "doc", "lidardesign")
NOT_SOURCES = ("__pycache__", "*.egg-info", "build", "runs", "*.pyc", ".*")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def sources(tmp_path_factory) -> Path:
    """A copy of the sources, so that the checkout stays as it is."""
    pytest.importorskip("setuptools", minversion="77", reason="building a wheel offline needs setuptools")
    copy = tmp_path_factory.mktemp("sources")
    for name in FOLDERS:
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns(*NOT_SOURCES))
    for name in FILES:
        shutil.copy(ROOT / name, copy)
    return copy


@pytest.fixture(scope="module")
def unpacked(sources, tmp_path_factory) -> Path:
    """The sdist, unpacked."""
    out = tmp_path_factory.mktemp("sdist")
    code = f"from setuptools.build_meta import build_sdist; build_sdist({str(out)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=sources, check=True, capture_output=True)
    (path,) = out.glob("lidardesign-*.tar.gz")
    safely = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # of Python 3.11.4
    with tarfile.open(path) as archive:
        archive.extractall(out, **safely)
    return out / path.name.removesuffix(".tar.gz")


@pytest.fixture(scope="module")
def wheel(unpacked, tmp_path_factory) -> Path:
    """A wheel built from the sdist."""
    out = tmp_path_factory.mktemp("wheel")
    pip("wheel", "--no-build-isolation", "--no-deps", "--wheel-dir", str(out), str(unpacked))
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


PYTHONS = ("3.11.0", "3.12.0", "3.13.0")


def test_no_pin_that_is_installed_asks_for_a_newer_python_than_the_program():
    asked = {(one.name, one.version): one.metadata.get("Requires-Python") for one in importlib.metadata.distributions()}
    pins = [tuple(line.split("==")) for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line]
    ranges = {pin: SpecifierSet(asked[pin] or "") for pin in pins if pin in asked}
    assert len(ranges) > 50
    assert not [pin for pin, allowed in ranges.items() if not all(version in allowed for version in PYTHONS)]


@pytest.mark.skipif("CI" not in os.environ, reason="asks the package index of every pin, half a minute: in CI")
@pytest.mark.parametrize("version", PYTHONS)
def test_every_pin_has_a_file_for_every_python(version):
    """Also those of documentation and releases, which tests do not install."""
    asked = ["install", "--dry-run", "--no-deps", "--ignore-installed", "--target", "nowhere"]
    pip(*asked, "--python-version", version, "-r", str(ROOT / "constraints.txt"))


def test_the_sdist_holds_every_file_of_the_checkout(sources, unpacked):
    names = {path.relative_to(sources).as_posix() for path in sources.rglob("*") if path.is_file()}
    built = {name for name in names if ".egg-info/" in name}
    assert not [name for name in names - built if not (unpacked / name).is_file()]


def test_tests_pass_in_the_unpacked_sdist(unpacked):
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTEST_ADDOPTS")}
    some = ["tests/test_space.py", "tests/run/test_yaml.py"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *some]
    ended = subprocess.run(command, cwd=unpacked, env=clean, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_the_wheel_holds_every_module_and_data_file_and_no_tests(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {path.relative_to(ROOT).as_posix() for path in (ROOT / "lidardesign").rglob("*.py")}
    expected |= {path.relative_to(ROOT / "tasks").as_posix() for path in (ROOT / "tasks").rglob("*.py")}
    for data in ("py.typed", "*.json", "*.yaml", "*.css", "*.js", "templates/*", "template/*.txt"):
        found = {path.relative_to(ROOT).as_posix() for path in (ROOT / "lidardesign").rglob(data)}
        assert found, data
        expected |= found
    data = ROOT / "tasks" / "lidardesign_tasks" / "data"
    expected |= {path.relative_to(ROOT / "tasks").as_posix() for path in data.iterdir() if path.is_file()}
    expected |= {f"{PAGES.as_posix()}/{path.name}" for path in (ROOT / "docs").glob("*.md")}
    assert expected <= {re.sub(r"^lidardesign-[^/]*\.data/data/", "", name) for name in names}
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


def test_pages_that_help_and_errors_of_an_installed_wheel_name_can_be_opened(installed, tmp_path):
    said = run_installed(installed, tmp_path, "constrain", "--help").stdout
    names, place = re.search(r"^ +See also: (.*)\n +in (.*)$", said, re.MULTILINE).groups()
    assert Path(place) == installed / PAGES
    assert all((Path(place) / name).is_file() for name in names.split(", "))
    (tmp_path / "parts").mkdir()
    error = run_installed(installed, tmp_path, "catalog", "list", "--catalog", "parts").stderr
    assert f"{installed / PAGES / 'catalog.md'} shows a part file" in " ".join(error.split())


def test_every_page_that_a_message_names_is_there():
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "lidardesign").rglob("*.py")]
    named = {name for text in texts for name in re.findall(r"\bpage\([\"']([^\"']+)[\"']\)", text)}
    assert {"catalog.md", "constraints.txt"} <= named
    assert not [name for name in named if not ((ROOT / "docs" / name).is_file() or (ROOT / name).is_file())]


def install_step(workflow: Path) -> str:
    """The command of a workflow that installs."""
    (job,) = yaml.load(workflow.read_text(encoding="utf-8"), Loader=yaml.BaseLoader)["jobs"].values()
    (command,) = (step["run"] for step in job["steps"] if "pip install" in step.get("run", ""))
    return command


@pytest.mark.parametrize(
    ("workflow", "source"),
    [("gate", "path"), ("gate", "wheel"), ("gate", "index"), ("gate", "repository"), ("new task", "path")],
)
def test_a_workflow_installs_the_program_from_wherever_it_is(unpacked, wheel, tmp_path, workflow, source):
    """What pip does offline: what the program needs is there, and nothing is downloaded."""
    folder = tmp_path / "checkout"
    if workflow == "new task":
        new_task("landmark", folder)
        command = install_step(folder / ".github" / "workflows" / "test.yml")
    else:
        folder.mkdir()
        shutil.copy(ROOT / "constraints.txt", folder)
        command = install_step(ROOT / "examples" / "ci" / "lidar-design.yml")
    (folder / "vendor").mkdir()
    if source == "wheel":
        shutil.copy(wheel, folder / "vendor")
    elif source in ("path", "repository"):
        shutil.copytree(unpacked, folder / "vendor" / "lidardesign", ignore=shutil.ignore_patterns("*.egg-info"))
    if source == "repository":
        for words in (
            ["init", "-q"],
            ["add", "."],
            ["-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-qm", "all"],
        ):
            subprocess.run(["git", *words], cwd=folder / "vendor" / "lidardesign", check=True, capture_output=True)
    sources = {
        "path": "vendor/lidardesign",
        "wheel": f"vendor/{wheel.name}",
        "index": "lidardesign",
        "repository": f"git+{(folder / 'vendor' / 'lidardesign').as_uri()}",
    }
    python = environment_without_the_program(tmp_path / "venv")
    offline = {
        "PIP_NO_INDEX": "1", "PIP_FIND_LINKS": wheel.parent.as_uri(), "PIP_NO_DEPS": "1", "PIP_NO_BUILD_ISOLATION": "0",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
    }  # fmt: skip
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**clean, **offline, "PATH": path, "LIDARDESIGN": sources[source]}
    ended = subprocess.run(
        ["bash", "-eo", "pipefail", "-c", command],
        cwd=folder, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    listed = subprocess.run(
        ["lidardesign", "tasks", "list"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    ).stdout
    assert "flatland" in listed
    assert ("landmark" in listed) == (workflow == "new task")


def environment_without_the_program(folder: Path) -> Path:
    """The Python of a virtual environment that has all that the tests have, but for this program."""
    venv.create(folder, with_pip=False)
    places = sysconfig.get_paths(vars={"base": str(folder), "platbase": str(folder)})
    own, shared = Path(places["purelib"]), folder / "needed"
    shared.mkdir()
    for place in sysconfig.get_path("purelib"), sysconfig.get_path("platlib"):
        for entry in Path(place).iterdir():
            link = shared / entry.name
            if "lidardesign" not in entry.name and not link.exists():
                link.symlink_to(entry)
    (own / "needed.pth").write_text(f"import sys; sys.path.append({str(shared)!a})\n")
    (Path(places["scripts"]) / "pip").write_text(f'#!/bin/sh\nexec "{places["scripts"]}/python" -m pip "$@"\n')
    (Path(places["scripts"]) / "pip").chmod(0o755)
    return Path(places["scripts"]) / "python"
