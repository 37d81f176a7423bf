"""What type checkers and editors see of the package: its names, what functions return, and whole scripts and tasks."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import lidardesign
from lidardesign.contract.scaffold import new_task

pytest.importorskip("mypy", reason="the extra `dev` is not installed")

ROOT = Path(__file__).parents[2]
# Nothing that a user calls has types of these, and torch alone is some 1,500 files.
NOT_FOLLOWED = "dask distributed mujoco numba plotly rich scipy sympy torch trimesh typer zuko"
REVEALED = {
    'ld.learn("x")': "lidardesign.api.run.Run",
    'ld.open_run("x").fit(sensors=2)': "lidardesign.api.design.Design",
    'ld.load_design("x").constrain(rays=8)': "lidardesign.api.design.Design",
    'ld.open_run("x").evaluate([], rays=[8])': "lidardesign.api.scores.Scores",
    'ld.load_design("x").rays(8)': "lidardesign.scenes.rays.Rays",
    "ld.evaluate_seeds([])": "lidardesign.api.scores.Scores",
}
WRONG = {
    'ld.lern("x")': "attr-defined",
    'ld.learn("x", sed=3)': "call-arg",
    'ld.open_run("x").fit(sensers=3)': "call-arg",
    'ld.open_run("x").evaluate(rays="8")': "arg-type",
    'ld.learn("x", progress=len)': "arg-type",
}


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """What mypy says of each file: the script of docs/python.md, the scaffold of a task, and small scripts."""
    folder = tmp_path_factory.mktemp("typed")
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(encoding="utf-8"), re.DOTALL)
    (folder / "script.py").write_text("".join(blocks), encoding="utf-8")
    new_task("landmark", folder / "task")
    names = [name for name in lidardesign.__all__ if name != "__version__"]
    lines = ["import lidardesign as ld", *(f"ld.{name}" for name in names)]
    lines += [*(f"reveal_type({call})" for call in REVEALED), *WRONG]
    (folder / "names.py").write_text("\n".join(lines) + "\n")
    passed_over = ",".join(f"mypy-{package}.*" for package in NOT_FOLLOWED.split())
    (folder / "mypy.ini").write_text(f"[mypy]\n[{passed_over}]\nfollow_imports = skip\n")
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--follow-imports", "silent", "--cache-dir", folder / "cache",
         "--no-error-summary", "script.py", "names.py", "task/lidardesign_landmark"],
        cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "MYPYPATH": os.pathsep.join(map(str, (ROOT, folder / "task")))},
    )  # fmt: skip
    assert done.stderr == ""
    said = {}
    for line in done.stdout.splitlines():
        file, number, text = line.split(":", 2)
        said.setdefault(Path(file).parts[0], []).append((int(number), text.strip()))
    return said, lines


@pytest.mark.slow
@pytest.mark.parametrize("file", ["script.py", "task"])
def test_a_users_script_and_a_new_task_have_no_errors_of_types(checked, file):
    assert checked[0].get(file, []) == []


@pytest.mark.slow
def test_every_name_of_the_package_is_known_and_every_mistake_is_found(checked):
    said, lines = checked
    found = [(lines[number - 1], text) for number, text in said["names.py"]]
    for call, kind in REVEALED.items():
        assert (f"reveal_type({call})", f'note: Revealed type is "{kind}"') in found
    errors = [(line, text.split()[-1]) for line, text in found if text.startswith("error")]
    assert errors == [(call, f"[{code}]") for call, code in WRONG.items()]


def test_the_names_that_type_checkers_see_are_those_that_are_imported():
    for name in lidardesign.__all__:
        assert getattr(lidardesign, name) is not None
    with pytest.raises(AttributeError):
        lidardesign.nothing  # noqa: B018 - the attribute is asked for
    listed = {name for names in lidardesign._HOMES.values() for name in names.split()}
    assert listed == set(lidardesign.__all__) - {"__version__"}
