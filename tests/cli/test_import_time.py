"""Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import subprocess
import sys

import pytest
from support.command_line import make_run

HEAVY = ["torch", "zuko", "numba", "scipy", "trimesh", "igl", "embreex", "h5py", "matplotlib", "plotly", "numpy.f2py"]
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


def test_importing_the_package_imports_nothing_heavy():
    assert not modules_after("import lidardesign") & {*HEAVY, *NUMERIC}


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["learn", "--help"], ["constrain", "--help"]])
def test_help_imports_nothing_heavy(arguments):
    assert not modules_after(run_program(*arguments)) & {*HEAVY, *NUMERIC}


@pytest.mark.parametrize("arguments", [["export", "--list"], ["tasks", "list"], ["catalog", "list"]])
def test_lists_import_nothing_heavy(arguments):
    assert not modules_after(run_program(*arguments)) & {*HEAVY}


def test_a_fitted_mixture_is_constrained_shown_and_exported_without_heavy_libraries(tmp_path):
    run, rays = make_run(tmp_path / "run"), tmp_path / "rays.csv"
    commands = (
        ["constrain", run, "--layout", "grid", "--sensors", 2, "--set", "gate.width_m.max=0.2", "--name", "narrow"],
        ["show", run],
        ["show", run / "designs" / "narrow.yaml"],
        ["export", run / "designs" / "narrow.yaml", "--rays", 100, "--format", "csv", "--out", rays],
    )
    loaded = modules_after("\n".join(run_program(*map(str, words)) for words in commands))
    assert not loaded & {*HEAVY}
    assert rays.exists()


def test_threads_are_limited_before_torch_can_be_imported():
    code = "import os\nos.environ.pop('OMP_NUM_THREADS', None)\nos.environ['OPENBLAS_NUM_THREADS'] = '3'\n"
    code += run_program("--version") + "\nassert os.environ['OMP_NUM_THREADS'] == '1', os.environ\n"
    code += "assert os.environ['OMP_WAIT_POLICY'] == 'PASSIVE'\nassert os.environ['OPENBLAS_NUM_THREADS'] == '3'"
    modules_after(code)
