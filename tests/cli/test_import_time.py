"""Nothing heavy is imported before a command needs it."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ["torch", "zuko", "numba", "scipy.stats", "trimesh", "igl", "embreex", "h5py", "matplotlib", "plotly"]
NUMERIC = ["numpy", "scipy", "yaml"]


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


def test_listing_formats_and_tasks_imports_no_torch():
    loaded = modules_after(run_program("export", "--list") + "\n" + run_program("tasks", "list"))
    assert not loaded & {"torch", "zuko", "plotly", "matplotlib"}


def test_the_modules_that_constrain_needs_import_no_torch():
    constraints = ("design.constraints.check", "design.constraints.document")
    names = ("config", "samples", "design.files", "design.fit", *constraints)
    code = "\n".join(f"import lidardesign.{name}" for name in names)
    assert not modules_after(code) & {"torch", "zuko", "numba", "trimesh", "matplotlib", "plotly", "scipy.stats"}


def test_threads_are_limited_before_torch_can_be_imported():
    code = "import os\nos.environ.pop('OMP_NUM_THREADS', None)\nos.environ['OPENBLAS_NUM_THREADS'] = '3'\n"
    code += run_program("--version") + "\nassert os.environ['OMP_NUM_THREADS'] == '1', os.environ\n"
    code += "assert os.environ['OMP_WAIT_POLICY'] == 'PASSIVE'\nassert os.environ['OPENBLAS_NUM_THREADS'] == '3'"
    modules_after(code)
