"""Imports run downward, heavy libraries stay where they belong, functions stay short."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lidardesign"
MODULES = sorted(PACKAGE.rglob("*.py"))
TASK_MODULES = sorted((ROOT / "tasks" / "lidardesign_tasks").rglob("*.py"))
MAX_FUNCTION_LINES = 60

# A module may import modules of a lower or the same number; the most specific name counts.
LAYERS = {
    "lidardesign": 0,
    "lidardesign.__main__": 13,
    "lidardesign.errors": 0,
    "lidardesign.estimates": 1,
    "lidardesign.numerics": 0,
    "lidardesign.run": 0,
    "lidardesign.deprecation": 1,
    "lidardesign.run.streams": 1,
    "lidardesign.run.files": 1,
    "lidardesign.run.processes": 1,
    "lidardesign.run.csv_rows": 1,
    "lidardesign.run.npz": 1,
    "lidardesign.run.yaml": 1,
    "lidardesign.run.kinds": 2,
    "lidardesign.run.manifest": 2,
    "lidardesign.run.lock": 2,
    "lidardesign.run.clock": 3,
    "lidardesign.run.overrides": 2,
    "lidardesign.run.validation": 2,
    "lidardesign.run.checkpoint": 3,
    "lidardesign.space": 2,
    "lidardesign.rotations": 0,
    "lidardesign.scene": 3,
    "lidardesign.orientation": 2,
    "lidardesign.vertex_weights": 3,
    "lidardesign.meshio": 3,
    "lidardesign.simulate": 4,
    "lidardesign.simulate.hits": 4,
    "lidardesign.simulate.primitives": 4,
    "lidardesign.simulate.raycast": 4,
    "lidardesign.simulate.receiver_view": 4,
    "lidardesign.simulate.returns": 4,
    "lidardesign.simulate.triangles": 4,
    "lidardesign.surface": 4,
    "lidardesign.density": 4,
    "lidardesign.density.settings": 4,
    "lidardesign.task": 5,
    "lidardesign.probe": 5,
    "lidardesign.registry": 6,
    # the package itself imports nothing until a name of it is used
    "lidardesign.testing": 0,
    "lidardesign.run.config": 7,
}
FOLDERS = {"density": 8, "design": 9, "simulate": 10, "evaluate": 11, "export": 12, "testing": 12, "cli": 13}
# design.samples is what learning leaves behind: the density writes it, the design reads it
SPECIAL = {"lidardesign.design": 7, "lidardesign.design.samples": 7}

HOMES = {
    "torch": ("lidardesign.density.",),
    "zuko": ("lidardesign.density.",),
    "embreex": ("lidardesign.simulate.triangles",),
    "cma": ("lidardesign.evaluate.cma_search",),
    "mujoco": (),
    "mink": (),
    "typer": ("lidardesign.cli.",),
    "rich": ("lidardesign.cli.",),
    "plotly": ("lidardesign.evaluate.report",),
    "matplotlib": ("lidardesign.evaluate.plots", "lidardesign.evaluate.pareto"),
    "distributed": ("lidardesign.evaluate.worker_cluster",),
    "dask": (),
    # it can abort its process: only the one of its own imports it
    "mitsuba": ("lidardesign.simulate.light_transport_worker",),
    "mitransient": ("lidardesign.simulate.light_transport_worker",),
    "drjit": ("lidardesign.simulate.light_transport_worker",),
}
# safetensors writes checkpoints of torch tensors beside the density, in the run
TORCH_SIDE_FILES = ("lidardesign.run.checkpoint",)
SLOW_AT_TOP = {
    "torch",
    "cma",
    "numba",
    "trimesh",
    "matplotlib",
    "plotly",
    "igl",
    "h5py",
    "scipy.stats",
    "zuko",
    "embreex",
}
FAST_LAYERS = (
    "lidardesign.run.",
    "lidardesign.design.",
    "lidardesign.cli.",
    "lidardesign.registry",
    "lidardesign.task",
)


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(tree: ast.AST) -> list[tuple[str, int]]:
    """Every imported module, with its line; `from a import b` counts as a.b where that is a module."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in line {node.lineno}"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                path = ROOT.joinpath(*whole.split("."))
                is_module = path.with_suffix(".py").exists() or (path / "__init__.py").exists()
                found.append((whole if is_module else str(node.module), node.lineno))
    return found


def without_type_checking(tree: ast.Module) -> ast.Module:
    """The module as it runs: blocks under `if TYPE_CHECKING:` import nothing."""
    for node in ast.walk(tree):
        for name in ("body", "orelse"):
            block = getattr(node, name, None)
            if isinstance(block, list):
                setattr(node, name, [item for item in block if not _is_type_checking(item)])
    return tree


def _is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def parse(path: Path) -> ast.Module:
    return without_type_checking(ast.parse(path.read_text(encoding="utf-8"), str(path)))


def layer(name: str) -> int:
    if name in SPECIAL:
        return SPECIAL[name]
    if name in LAYERS:
        return LAYERS[name]
    folder = name.split(".")[1]
    assert folder in FOLDERS, f"{name} has no layer: name it in tests/test_layers.py"
    return FOLDERS[folder]


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_run_downward(path):
    name = module_name(path)
    for imported, line in imports(parse(path)):
        if imported.split(".")[0] == "lidardesign":
            allowed = layer(imported) <= layer(name) or is_part_of(imported, name)
            assert allowed, (
                f"{path}:{line}: {name} (layer {layer(name)}) imports {imported} (layer {layer(imported)})"
            )


def is_part_of(imported: str, name: str) -> bool:
    return imported == name.rpartition(".")[0]


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_heavy_libraries_stay_where_they_belong(path):
    name = module_name(path)
    for imported, line in imports(parse(path)):
        homes = HOMES.get(imported.split(".")[0])
        if homes and name not in TORCH_SIDE_FILES:
            assert any(f"{name}.".startswith(home) or name == home for home in homes), (
                f"{path}:{line}: {imported}"
            )


@pytest.mark.parametrize(
    "path", [p for p in MODULES if module_name(p).startswith(FAST_LAYERS)], ids=module_name
)
def test_modules_of_fast_commands_import_nothing_slow_at_their_top(path):
    tree = parse(path)
    top = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    for imported, line in imports(top):
        slow = {imported, imported.split(".")[0], ".".join(imported.split(".")[:2])} & SLOW_AT_TOP
        assert not slow or module_name(path) in TORCH_SIDE_FILES, f"{path}:{line}: {imported}"


@pytest.mark.parametrize("path", TASK_MODULES, ids=module_name)
def test_tasks_import_the_robot_engine_only_when_an_arm_moves(path):
    tree = parse(path)
    top = ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], [])
    for imported, line in imports(top):
        assert imported.split(".")[0] not in ("mujoco", "mink"), f"{path}:{line}: {imported}"


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_nothing_imports_the_shipped_tasks(path):
    for imported, line in imports(parse(path)):
        assert imported.split(".")[0] != "lidardesign_tasks", f"{path}:{line}"


@pytest.mark.parametrize("path", MODULES + TASK_MODULES, ids=module_name)
def test_functions_are_short(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = node.end_lineno - node.lineno + 1
            assert length <= MAX_FUNCTION_LINES, f"{path}:{node.lineno}: {node.name} has {length} lines"


# what it reads back it has written itself a line before
MAKES_PICKLES_ONLY = ("lidardesign.testing.scenes",)


@pytest.mark.parametrize("path", MODULES + TASK_MODULES, ids=module_name)
def test_no_code_unpickles_or_loads_unsafe_yaml(path):
    forbidden = {"pickle", "dill", "joblib", "cloudpickle", "shelve", "marshal"}
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if path in MODULES and module_name(path) in MAKES_PICKLES_ONLY:
        forbidden -= {"pickle"}
    for imported, line in imports(tree):
        assert imported.split(".")[0] not in forbidden, f"{path}:{line}: {imported}"
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "yaml":
            assert node.attr not in {"load", "load_all", "unsafe_load", "full_load"}, f"{path}:{node.lineno}"


def modules_with_exports() -> list[Path]:
    return [path for path in MODULES if "__all__" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", modules_with_exports(), ids=module_name)
def test_exported_names_exist(path):
    module = importlib.import_module(module_name(path))
    for name in module.__all__:
        assert hasattr(module, name), f"{module.__name__}.__all__ names {name}"


# Values with units and measured seconds are no guards against rounding: these modules may name them.
PHYSICAL_VALUES = {
    "lidardesign.design.bandwidth": {"SECONDS_PER_PICOSECOND"},
    "lidardesign.design.check": {"PICOSECOND_S"},
    "lidardesign.design.galvo": {"SPEED_OF_LIGHT_M_PER_PS"},
    "lidardesign.density.kernels": {"EXP_POLYNOMIAL", "LN2_HIGH"},
    "lidardesign.simulate.cost": {"SUB_RAY_SECONDS", "LIGHT_SECONDS", "PHOTON_SECONDS", "ROUNDING_SECONDS"},
    "lidardesign.simulate.daylight": {"SUN_AT_100_KLUX", "LED_AT_1_LUX"},
    "lidardesign.simulate.detector": {"PLANCK_J_S"},
    "lidardesign.simulate.detector_files": {"TIMES", "ENERGIES", "LENGTHS", "TIMING", "LIGHT"},
    "lidardesign.simulate.effects.multipath": {"FAINTEST_SHARE"},
    "lidardesign.simulate.plan": {"LENGTHS_M"},
    "lidardesign.simulate.streams": {"TAIL_TOP", "TAIL_BOTTOM", "FAR_TOP", "FAR_BOTTOM"},
}
SMALLEST_PLAIN_NUMBER = 1e-5
FLOAT_LIMITS = {"eps", "tiny", "smallest_normal", "epsilon"}


@pytest.mark.parametrize("path", MODULES + TASK_MODULES, ids=lambda path: path.stem)
def test_no_epsilon_stands_outside_numerics(path):
    """Neither a tiny literal nor a limit of the floating-point format: a guard has one home, and its reason there."""
    if path == PACKAGE / "numerics.py":
        return
    allowed = PHYSICAL_VALUES.get(module_name(path), set())
    for statement in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = getattr(statement, "targets", None) or [getattr(statement, "target", None)]
        if any(isinstance(target, ast.Name) and target.id in allowed for target in targets):
            continue
        for node in ast.walk(statement):
            size = abs(node.value) if isinstance(node, ast.Constant) and isinstance(node.value, float) else 0.0
            assert not 0 < size < SMALLEST_PLAIN_NUMBER, f"{path}:{node.lineno}: {node.value!r}"
            limit = isinstance(node, ast.Attribute) and node.attr in FLOAT_LIMITS
            assert not limit, f"{path}:{node.lineno}: .{node.attr}"
