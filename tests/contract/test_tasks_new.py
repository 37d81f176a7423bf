"""A new task and the example of a third party's package pass their own tests, untouched, in their own environment."""

from __future__ import annotations

import os
import re
import shutil
import site
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
from support.command_line import files_under
from support.docs_output import difference
from support.docs_pages import blocks_of, commands_of
from support.docs_session import COLUMNS
from support.plugins import GOOD, install_plugins

from lidardesign.contract.contract import LAWS
from lidardesign.contract.law import LOADS
from lidardesign.contract.scaffold import LONGEST_NAME, new_task
from lidardesign.errors import ConfigError, DataError

pytest_plugins = ["pytester"]
ROOT = Path(__file__).parents[2]
TEMPLATES = ROOT / "lidardesign" / "contract" / "template"
EXAMPLE, STREET = ROOT / "examples" / "third_party", ROOT / "examples" / "street"
NAME = "landmark"


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """A virtual environment of its own with a new package and the examples in it; packages by name."""
    pytest.importorskip("setuptools", minversion="77", reason="building a wheel offline needs setuptools")
    root = tmp_path_factory.mktemp("environment")
    new_task(NAME, root / "new")
    folders = {"new": root / "new", "example": root / "example", "street": root / "street"}
    for name, source in (("example", EXAMPLE), ("street", STREET)):
        shutil.copytree(source, folders[name], ignore=shutil.ignore_patterns("__pycache__", "*.egg-info", "build"))
    venv.create(root / "venv", with_pip=False)
    python = root / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    # what is installed for these tests, this package too, is there as it is here
    own = Path(sysconfig.get_paths(vars={"base": str(root / "venv"), "platbase": str(root / "venv")})["purelib"])
    lines = [f"import site; site.addsitedir({place!a})" for place in site.getsitepackages()]
    (own / "installed_for_tests.pth").write_text("\n".join(lines) + "\n")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "--python", str(python), "install"]
    done(*pip, "--no-deps", "--no-build-isolation", *map(str, folders.values()), cwd=root)
    return python, folders


def done(*command: str, cwd: Path) -> str:
    """What a command prints, which must end well."""
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTEST_ADDOPTS")}
    ended = subprocess.run(
        command, cwd=cwd, env={**clean, "COLUMNS": str(COLUMNS)}, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.mark.slow
@pytest.mark.parametrize("package", ["new", "example", "street"])
def test_the_package_passes_its_own_tests_untouched_in_its_own_environment(environment, package):
    python, folders = environment
    shutil.rmtree(folders[package] / "build", ignore_errors=True)
    said = done(str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", cwd=folders[package])
    assert " passed" in said
    assert "failed" not in said


def shown_check(page: Path, task: str) -> list[str]:
    """What a page says that the check of a task prints."""
    blocks = [block for block in blocks_of(page) if block.language == "console"]
    commands = [command for block in blocks for command in commands_of(block)]
    (expected,) = (command.output for command in commands if command.words == ["lidardesign", "tasks", "check", task])
    return expected


@pytest.mark.slow
def test_checking_the_installed_task_prints_what_the_guide_says(environment, tmp_path):
    expected = shown_check(ROOT / "docs" / "writing-tasks.md", NAME)
    said = done(str(environment[0]), "-m", "lidardesign", "tasks", "check", NAME, cwd=tmp_path)
    assert difference(expected, said, "", small=False) is None
    assert files_under(tmp_path) == {}


def test_the_example_shows_every_law_as_kept():
    shown = "\n".join(shown_check(EXAMPLE / "README.md", "landing"))
    assert re.findall(r"^│ (\w.*?) +│ (\w+) │", shown, re.MULTILINE) == [
        (name, "skip" if name == "preparing repeats" else "pass") for name in (LOADS[0], *(law.name for law in LAWS))
    ]


def test_the_guide_lists_every_law_and_shows_the_tests_that_are_written():
    guide = (ROOT / "docs" / "writing-tasks.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \| ([^|]+) \|$", guide, re.MULTILINE)
    assert [row for row in rows if row[0] in {law.name for law in LAWS}] == [(law.name, law.statement) for law in LAWS]
    shown = {block.file: block.text for block in blocks_of(ROOT / "docs" / "writing-tasks.md")}
    assert shown["tests/test_contract.py"] in (TEMPLATES / "test_contract.py.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["a", "abcdefghij_klmnopqrst_uvwxyz_9"])
def test_a_new_package_is_clean_whatever_the_length_of_its_name(tmp_path, name):
    ruff = shutil.which("ruff", path=str(Path(sys.executable).parent)) or shutil.which("ruff")
    if ruff is None:
        pytest.skip("ruff is not installed here")
    assert len(name) <= LONGEST_NAME
    new_task(name, tmp_path / "package")
    done(ruff, "check", "--no-cache", ".", cwd=tmp_path / "package")
    done(ruff, "format", "--no-cache", "--check", ".", cwd=tmp_path / "package")


def test_the_command_writes_every_file_and_says_what_comes_next(lidardesign, tmp_path):
    result = lidardesign("tasks", "new", "landmark")
    assert result.code == 0, result.err
    written = files_under(tmp_path / "lidardesign-landmark")
    assert set(written) == {
        ".github/workflows/test.yml", ".gitignore", "README.md", "pyproject.toml",
        "lidardesign_landmark/__init__.py", "lidardesign_landmark/config.py", "lidardesign_landmark/task.py",
        "tests/test_contract.py", "tests/test_task.py", "constraints.txt",
    }  # fmt: skip
    assert not [path for path, content in written.items() if b"@@" in content]
    assert "lidardesign tasks check landmark" in result.out
    again = lidardesign("tasks", "new", "landmark", "--json")
    assert again.code == 3
    assert again.json["error"]["message"] == "already exists"
    elsewhere = lidardesign("tasks", "new", "landmark", "--out", "place", "--json").json
    assert {Path(path).as_posix() for path in elsewhere["files"]} == {f"place/{path}" for path in written}


NO_NAMES = ("Landmark", "land-mark", "", "1st", "a__b", "../up", "a b", "x" * 31, "landmärke", "a\n")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        *((name, "is not a name for a task") for name in NO_NAMES),
        ("face", "a task 'face' is installed"),
        ("tasks", "module lidardesign_tasks"),
    ],
)
def test_a_name_that_is_none_or_taken_is_refused_and_nothing_is_written(tmp_path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=words):
        new_task(name)
    assert files_under(tmp_path) == {}


def test_a_folder_that_holds_something_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for place in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(DataError, match="already exists"):
            new_task("landmark", place)
    assert files_under(tmp_path) == {"notes.txt": b"mine"}


CONTRACT_TEST = "def test_contract(task_law):\n    print(task_law.check())\n"


def test_the_fixture_runs_one_test_per_task_and_law_and_names_what_is_broken(pytester, monkeypatch):
    backwards = GOOD.replace('"lower", worst=100.0', '"higher", worst=0.0')
    install_plugins(pytester.path / "installed", {"fixture_good": GOOD, "fixture_backwards": backwards})
    monkeypatch.syspath_prepend(pytester.path / "installed")
    pytester.makeini("[pytest]\nlidardesign_tasks =\n    fixture_good\n    fixture_backwards\n")
    pytester.makepyfile(CONTRACT_TEST)
    result = pytester.runpytest_inprocess("-k", "best or metric or inform", "-rf")
    result.assert_outcomes(passed=3, skipped=1 + 1, failed=1)
    result.stdout.fnmatch_lines(["best on the truth: the score does not reward seeing the targets: *"])
    result.stdout.fnmatch_lines(["FAILED *fixture_backwards: best on the truth*"])


def test_a_test_that_asks_for_laws_of_no_task_is_told_where_to_name_one(pytester):
    pytester.makepyfile(CONTRACT_TEST)
    result = pytester.runpytest_inprocess()
    result.stdout.fnmatch_lines(["*asks for task_law: name tasks in lidardesign_tasks*"])
    assert result.ret != 0
