"""Nothing heavy is imported before a command needs it, and everything can be where little can be written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.command_line import make_run

import lidardesign

# scipy by itself takes four milliseconds, and its parts come when they are used
PARTS = [f"scipy.{part}" for part in ("linalg", "optimize", "sparse", "spatial", "special", "stats")]
HEAVY = [
    "torch", "zuko", "numba", *PARTS, "trimesh", "igl", "embreex", "h5py", "matplotlib", "plotly",
    "jinja2", "numpy.f2py",
]  # fmt: skip
NUMERIC = ["numpy", "yaml"]


def modules_after(code: str) -> set[str]:
    """Names of all modules that a fresh interpreter holds after running some code."""
    script = f"import sys\n{code}\nprint('\\n'.join(sys.modules), file=sys.stderr)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(result.stderr.split())


def run_program(*arguments: str) -> str:
    return (
        "from lidardesign.cli.main import run\n"
        f"try: run({list(arguments)!r})\n"
        "except SystemExit as error: assert not error.code, error.code"
    )


def run_all(*commands) -> str:
    return "\n".join(run_program(*map(str, words)) for words in commands)


def test_neither_the_package_nor_help_imports_anything_heavy():
    commands = (["--help"], ["--version"], ["learn", "--help"], ["constrain", "--help"])
    assert not modules_after("import lidardesign\n" + run_all(*commands)) & {*HEAVY, *NUMERIC}


def test_lists_import_nothing_heavy():
    assert not modules_after(run_all(["export", "--list"], ["tasks", "list"], ["catalog", "list"])) & {*HEAVY}


@pytest.fixture(scope="module")
def chosen(tmp_path_factory):
    """A design of chosen rays in its run."""
    run = lidardesign.open_run(make_run(tmp_path_factory.mktemp("made") / "run"))
    return run.fit(sensors=2, rays=8, name="chosen").save()


def test_runs_and_designs_are_shown_and_exported_without_heavy_libraries(chosen, tmp_path):
    rays = tmp_path / "rays.csv"
    commands = (["show", chosen.parents[1]], ["show", chosen], ["export", chosen, "--format", "csv", "--out", rays])
    assert not modules_after(run_all(*commands)) & {*HEAVY}
    assert rays.exists()


def test_sensors_of_even_rays_are_constrained_without_heavy_libraries(chosen, tmp_path):
    run = shutil.copytree(chosen.parents[1], tmp_path / "run")
    # a region needs no density at any one place
    keys = ["--set", "gate.width_m.max=0.2", "--set", "origin.spread_m.max=0.5"]
    command = ["constrain", run, "--layout", "even", "--sensors", 2, *keys, "--name", "narrow"]
    assert not modules_after(run_program(*map(str, command))) & {*HEAVY}


def test_threads_are_limited_before_torch_can_be_imported():
    code = "import os\nos.environ.pop('OMP_NUM_THREADS', None)\nos.environ['OPENBLAS_NUM_THREADS'] = '3'\n"
    code += run_program("--version") + "\nassert os.environ['OMP_NUM_THREADS'] == '1', os.environ\n"
    code += "assert os.environ['OMP_WAIT_POLICY'] == 'PASSIVE'\nassert os.environ['OPENBLAS_NUM_THREADS'] == '3'"
    modules_after(code)


def test_compiled_loops_are_imported_where_neither_package_nor_home_can_be_written(tmp_path):
    package = Path(lidardesign.__file__).parent
    copy = shutil.copytree(package, tmp_path / "lidardesign", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in {path.parent for path in copy.rglob("*.py")}:
        (folder / "__pycache__").touch()  # a file stops root too
    (tmp_path / "temporary files").mkdir()
    environment = {**os.environ, "HOME": os.devnull, "TMPDIR": str(tmp_path / "temporary files")}
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    code = "import os, lidardesign.scenes.distances as m; print(m.__file__, os.environ['XDG_CACHE_HOME'], sep='\\n')"
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    module, cache = map(Path, ended.stdout.splitlines())
    assert copy in module.parents
    assert cache.parent == tmp_path / "temporary files"
    assert cache.stat().st_mode & 0o777 == 0o700
    assert any(cache.glob("numba/*"))


@pytest.mark.parametrize(
    ("folder", "can"),
    [("new/deep", True), ("file", False), ("file/below", False), ("cache", False), (f"{os.devnull}/.cache", False)],
)
def test_a_cache_is_a_folder_that_can_be_written_or_made(tmp_path, folder, can):
    (tmp_path / "file").touch()
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "numba").touch()
    assert lidardesign._is_cache(str(tmp_path / folder)) == can


def test_without_a_home_no_folder_of_that_name_is_made():
    assert not lidardesign._is_cache("~/.cache")


@pytest.mark.parametrize("taken", ["nothing", "a link", "a file", "an open folder"])
def test_a_cache_of_others_is_not_used(tmp_path, monkeypatch, taken):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    place = tmp_path / f"lidardesign-{os.getuid()}"
    if taken == "a link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        place.symlink_to(tmp_path / "elsewhere")
    elif taken == "a file":
        place.touch()
    elif taken == "an open folder":
        place.mkdir()
        place.chmod(0o770)
    caches = {lidardesign._make_cache() for _ in range(2)}
    assert (str(place) in caches) == (taken == "nothing")
    assert len(caches) == (1 if taken == "nothing" else 2)
    assert all(Path(cache).stat().st_mode & 0o777 == 0o700 for cache in caches)
