"""What holds the house: rooms, floors, names and sizes. Every rule gathers all that break it."""

from __future__ import annotations

import ast
import collections
import importlib
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lidardesign"
TASKS = ROOT / "tasks" / "lidardesign_tasks"
MOST_MODULES = 14
BESIDE_ROOMS = {"docs", "fuzz", "soak", "tasks"}  # what tests in folders of their own are about, beside the rooms
MOST_PARAMETERS, MOST_KEYS, MOST_IMPORTS = 11, 4, 20

# From the ground up: a room imports its own modules and those of rooms before it.
ROOMS = (
    "errors", "limits", "numerics", "estimates", "run", "choices", "space", "scenes", "samples", "plugins", "task",
    "config", "run_folder", "workers", "density", "sensors", "parts", "constraints", "mixture", "simulate", "rays",
    "formats", "scoring", "problem", "fitting", "methods", "evaluation", "report", "clouds", "contract", "api",
    "studio", "cli", "__main__",
)  # fmt: skip

# Where a library may be imported, by the beginnings of module names; nowhere else.
HOMES = {
    "torch": ("density.",),
    "safetensors": ("density.",),
    "zuko": ("density.",),
    "embreex": ("scenes.triangles",),
    "cma": ("methods.cma",),
    "mujoco": ("scenes.mujoco_models.", "formats.mjcf."),
    "mink": (),
    "typer": ("cli.",),
    "click": ("cli.",),
    "rich": ("cli.",),
    "plotly": ("report.",),
    "jinja2": ("run.markup",),
    "markupsafe": ("run.markup",),
    "matplotlib": (),
    "viser": ("studio.",),
    "websockets": ("studio.server",),
    "distributed": ("workers.",),
    "dask": ("workers.",),
    # it can abort its process: only the one of its own imports it
    "mitsuba": ("simulate.light_transport.worker",),
    "mitransient": ("simulate.light_transport.worker",),
    "drjit": ("simulate.light_transport.worker",),
}
SLOW_AT_TOP = {
    "torch", "cma", "numba", "trimesh", "matplotlib", "plotly", "igl", "h5py", "scipy", "zuko", "embreex",
    "jinja2", "markupsafe",
}  # fmt: skip
FAST_ROOMS = (
    "limits", "run", "choices", "run_folder", "workers", "sensors", "parts", "constraints", "mixture", "fitting",
    "formats", "cli", "plugins", "task", "api", "config", "samples",
)  # fmt: skip

# Words that say nothing of what a module, class or function holds.
EMPTY_WORDS = {
    "told", "tell", "heard", "kept", "taken", "made", "worth", "beside", "aside", "looks", "judged", "shown", "found",
    "done",
}  # fmt: skip


def module_name(path: Path) -> str:
    parts = path.relative_to((PACKAGE if PACKAGE in path.parents else TASKS).parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def trees() -> dict[str, ast.Module]:
    """The modules of the package and of the shipped tasks by name."""
    paths = sorted([*PACKAGE.rglob("*.py"), *TASKS.rglob("*.py")])
    return {module_name(path): ast.parse(path.read_text(encoding="utf-8"), str(path)) for path in paths}


def package() -> dict[str, ast.Module]:
    return {name: tree for name, tree in trees().items() if name.startswith("lidardesign") and "_tasks" not in name}


@cache
def nodes_of(tree: ast.AST) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(tree))


@cache
def imported(tree: ast.AST) -> list[tuple[str, int]]:
    """Every imported module with its line; `from a import b` counts as a.b where that is a module."""
    names = []
    for node in nodes_of(tree):
        if isinstance(node, ast.Import):
            names += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            names += [(name if name in trees() else str(node.module), node.lineno) for name in whole]
    return names


@cache
def imports_of(name: str) -> tuple[str, ...]:
    # the package itself imports nothing: it names for type checkers what it imports when it is used
    found = {target for target, _ in imported(trees()[name]) if target in package()}
    return () if name == "lidardesign" else tuple(found - {name})


def room(name: str) -> str | None:
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[0] == "lidardesign" else None


def test_a_room_imports_only_rooms_below_it():
    floor = {name: height for height, name in enumerate(ROOMS)}
    upward = []
    for name in package():
        for target in imports_of(name):
            if room(name) and room(target) and floor.get(room(target), 0) > floor.get(room(name), 99):
                upward.append(f"{name} imports {target}")
    assert not upward, upward


def circles() -> list[list[str]]:
    """Groups of modules that import each other, lazily or for types alone too (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    groups: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = low[name] = len(index)
        stack.append(name)
        for target in imports_of(name):
            if target not in index:
                visit(target)
            if target in stack:
                low[name] = min(low[name], low[target])
        if low[name] == index[name]:
            group = stack[stack.index(name) :]
            del stack[stack.index(name) :]
            groups.append(group)

    for name in package():
        if name not in index:
            visit(name)
    return [sorted(group) for group in groups if len(group) > 1]


def test_no_modules_import_each_other():
    assert not circles()


def folder(name: str) -> str:
    return name if (PACKAGE.parent / Path(*name.split("."))).is_dir() else name.rpartition(".")[0]


def test_no_folders_import_each_other():
    """Neither side by side nor a folder and what stands above it: the tree shows which way data flow."""
    edges = {(folder(name), folder(target)) for name in package() for target in imports_of(name)}
    between = {(one, other) for one, other in edges if one != other and "lidardesign" not in (one, other)}
    assert not {pair for pair in between if pair[::-1] in between}


def test_folders_are_small_enough_to_overlook():
    crowded = {}
    for folder in {path.parent for path in PACKAGE.rglob("*.py")}:
        modules = [path.stem for path in folder.glob("*.py") if path.name != "__init__.py"]
        if len(modules) > MOST_MODULES:
            crowded[str(folder.relative_to(ROOT))] = len(modules)
    assert not crowded


def test_tests_stand_in_rooms_named_after_the_packages():
    rooms = {path.name for path in PACKAGE.iterdir() if path.is_dir()}
    astray = {path.parent.name for path in (ROOT / "tests").glob("*/test_*.py")} - rooms - BESIDE_ROOMS
    assert not astray


def test_a_public_class_name_stands_for_one_thing():
    homes = collections.defaultdict(list)
    for name, tree in package().items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(name)
    assert not {name: places for name, places in homes.items() if len(places) > 1}


def functions() -> list[tuple[str, ast.FunctionDef]]:
    return [
        (f"{name}.{node.name}", node)
        for name, tree in package().items()
        for node in nodes_of(tree)
        if isinstance(node, ast.FunctionDef)
    ]


def test_functions_take_few_parameters():
    """Commands and the Python interface too: what users choose is a table. Compiled code has no tables."""
    long = {}
    for name, node in functions():
        count = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
        if count > MOST_PARAMETERS and not any("njit" in ast.unparse(one) for one in node.decorator_list):
            long[name] = count
    assert not long


def test_options_of_the_command_line_are_made_in_one_module():
    makers = [name for name, tree in package().items() if re.search(r"\btyper\.Option\(", ast.unparse(tree))]
    assert makers == ["lidardesign.cli.terminal.options"]


# What a choice becomes once nothing is left open, and a design, which says how it was chosen.
RESOLVED = {"FitRequest", "EvaluationRequest", "DesignSpec", "DesignFile"}


def test_choices_are_written_once():
    """No function, and no class but those of what was resolved, repeats five keys of a table of choices."""
    choices = [node for name, tree in package().items() if room(name) == "choices" for node in tree.body]
    tables = [taken_by(node) for node in choices if isinstance(node, ast.ClassDef)]
    repeated = {}
    for name, tree in package().items():
        for node in ast.walk(tree) if room(name) != "choices" else ():
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name not in RESOLVED:
                shared = max((keys & taken_by(node) for keys in tables), key=len)
                if len(shared) > MOST_KEYS:
                    repeated[f"{name}.{node.name}"] = shared
    assert not repeated


# Names of layouts and baselines, which only their own code and files compare; rooms that still do, and how often.
KINDS = {
    "chosen", "even", "spinning", "uniform", "random", "bounding", "silhouette", "lloyd", "greedy", "occupancy", "cma",
    "no-visibility",
}  # fmt: skip
KNOW_KINDS = ("lidardesign.methods.", "lidardesign.sensors.", "lidardesign.constraints.check")
STILL_COMPARE = {"fitting": 23}


def test_nobody_asks_which_kind_of_design_he_holds():
    compared = collections.Counter()
    for name, tree in package().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare) and not name.startswith(KNOW_KINDS):
                words = [one for side in (node.left, *node.comparators) for one in ast.walk(side)]
                compared[room(name)] += any(isinstance(one, ast.Constant) and one.value in KINDS for one in words)
    assert {name: count for name, count in compared.items() if count > STILL_COMPARE.get(name, 0)} == {}


# What imports modules by their names: plugins, processes of their own, and what is imported when it is used.
IMPORT_BY_NAME = {
    "lidardesign", "lidardesign.contract", "lidardesign.contract.scenes",
    "lidardesign.run.processes", "lidardesign.scenes.mujoco_models",
}  # fmt: skip


def test_modules_are_imported_by_a_name_in_few_places():
    found = {
        name for name, tree in package().items() if re.search(r"\b(import_module|__import__)\(", ast.unparse(tree))
    }
    assert found <= IMPORT_BY_NAME


# Modules that still import from more rooms.
STILL_IMPORT = {
    "api.scores": 25, "studio.studio": 23, "fitting.chosen": 21, "fitting.fit": 25,
    "fitting.part_design": 26, "fitting.spinning": 21,
}  # fmt: skip


def test_a_module_imports_from_few_others():
    many = {}
    for name in package():
        count = sum(room(target) not in (None, room(name)) for target in imports_of(name))
        if count > STILL_IMPORT.get(name.removeprefix("lidardesign."), MOST_IMPORTS):
            many[name] = count
    assert not many


def test_libraries_stay_in_their_homes():
    astray = []
    for name, tree in package().items():
        for target, line in imported(tree):
            homes = HOMES.get(target.split(".")[0])
            if homes and not f"{name.removeprefix('lidardesign.')}.".startswith(tuple(homes)):
                astray.append(f"{name}:{line}: {target}")
    assert not astray


def test_tags_of_pages_stand_in_templates():
    tag = re.compile(r"</(p|div|table|t[rdh]|span|section|svg|label|button|details|figure|iframe)>")
    written = []
    for name, tree in package().items():
        texts = [node for node in nodes_of(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
        written += [f"{name}:{text.lineno}" for text in texts if tag.search(text.value)]
    assert not written


def top_imports(tree: ast.Module) -> list[tuple[str, int]]:
    return imported(ast.Module([node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)], []))


def test_modules_of_fast_commands_import_nothing_slow_at_their_top():
    slow = []
    for name, tree in package().items():
        if room(name) not in FAST_ROOMS:
            continue
        for target, line in top_imports(tree):
            if {target, target.split(".")[0], ".".join(target.split(".")[:2])} & SLOW_AT_TOP:
                slow.append(f"{name}:{line}: {target}")
    assert not slow


def test_tasks_import_the_robot_engine_only_when_an_arm_moves():
    early = [
        f"{name}:{line}"
        for name, tree in trees().items()
        if name.startswith("lidardesign_tasks")
        for target, line in top_imports(tree)
        if target.split(".")[0] in ("mujoco", "mink")
    ]
    assert not early


def test_shipped_tasks_import_what_a_task_of_a_stranger_would():
    """From the top of the package, what it exports; what is missing there is missing for everyone."""
    offered, inside = importlib.import_module("lidardesign").__all__, []
    for name, tree in trees().items():
        for node in nodes_of(tree) if name.startswith("lidardesign_tasks") else ():
            targets = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                targets = [f"{node.module}.{alias.name}" for alias in node.names]
            ours = [target for target in targets if target.split(".")[0] == "lidardesign"]
            inside += [f"{name}: {target}" for target in ours if target.removeprefix("lidardesign.") not in offered]
    assert not inside


def test_nothing_imports_the_shipped_tasks():
    assert not [name for name, tree in package().items() if "lidardesign_tasks" in str(imported(tree))]


def test_exported_names_exist():
    missing = []
    for name, tree in package().items():
        if any(isinstance(node, ast.Name) and node.id == "__all__" for node in nodes_of(tree)):
            module = importlib.import_module(name)
            missing += [f"{name}.{export}" for export in module.__all__ if not hasattr(module, export)]
    assert not missing


def described(node: ast.FunctionDef | ast.ClassDef) -> set[str]:
    """The names under "Arguments:" of a docstring."""
    section = re.search(r"^Arguments:\n((?:    .*\n?|\n)+)", ast.get_docstring(node) or "", re.MULTILINE)
    lines = re.findall(r"^    ([a-z_]\w*(?:, \w+)*):", section[1], re.MULTILINE) if section else []
    return {name for line in lines for name in line.split(", ")}


def taken_by(node: ast.FunctionDef | ast.ClassDef) -> set[str]:
    """The names of what a function or a dataclass takes."""
    if isinstance(node, ast.FunctionDef):
        all_ = node.args.posonlyargs + node.args.args + node.args.kwonlyargs
        return {one.arg for one in [*all_, node.args.vararg, node.args.kwarg] if one} - {"self", "cls"}
    own = [one.target.id for one in node.body if isinstance(one, ast.AnnAssign)]
    made = [one for one in node.body if isinstance(one, ast.FunctionDef) and one.name == "__init__"]
    return {*own, *(name for one in made for name in taken_by(one))}


def test_docstrings_describe_all_that_functions_take_and_nothing_else():
    wrong = {}
    for name, tree in trees().items():
        for node in nodes_of(tree):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and described(node):
                apart = described(node) ^ taken_by(node)
                # fields of a base are described where it is, and some fields only there
                if isinstance(node, ast.ClassDef):
                    apart = set() if node.bases else described(node) - taken_by(node)
                if apart:
                    wrong[f"{name}.{node.name}"] = apart
    assert not wrong


def weak(name: str) -> bool:
    return bool(EMPTY_WORDS & set(name.strip("_").split("_")[:1]))


def test_public_names_say_what_they_hold():
    empty = []
    for name, tree in package().items():
        empty += [name] if weak(name.rpartition(".")[2]) else []
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_") and weak(node.name):
                empty.append(f"{name}.{node.name}")
    assert not empty


def test_every_public_function_is_used_by_the_program():
    words = collections.Counter()
    for folder in ("lidardesign", "tasks", "examples", "benchmarks", "tools", "docs"):
        for path in [*(ROOT / folder).rglob("*.py"), *(ROOT / folder).rglob("*.md")]:
            words.update(set(re.findall(r"\w+", path.read_text(encoding="utf-8"))))
    lonely = []
    for name, tree in package().items():
        for node in tree.body:
            # pytest calls its hooks by their names
            hidden = isinstance(node, ast.FunctionDef) and node.name.startswith(("_", "pytest_"))
            is_plain = isinstance(node, ast.FunctionDef) and not hidden and not node.decorator_list
            if is_plain and words[node.name] == 1:
                uses = len(re.findall(rf"\b{node.name}\b", ast.unparse(tree)))
                lonely += [f"{name}.{node.name}"] if uses == 1 else []
    assert not lonely


# Values with units and measured seconds are no guards against rounding: these names may hold them.
PHYSICAL_VALUES = {
    "SECONDS_PER_PICOSECOND", "PICOSECOND_S", "SPEED_OF_LIGHT_M_PER_PS", "EXP_POLYNOMIAL", "LN2_HIGH",
    "SUB_RAY_SECONDS", "LIGHT_SECONDS", "PHOTON_SECONDS", "ROUNDING_SECONDS", "SUN_AT_100_KLUX", "LED_AT_1_LUX",
    "PLANCK_J_S", "TIMES", "ENERGIES", "LENGTHS", "TIMING", "LIGHT", "FAINTEST_SHARE", "LENGTHS_M", "TAIL_TOP",
    "TAIL_BOTTOM", "FAR_TOP", "FAR_BOTTOM", "LEAST_MASS_KG", "RANGE_TOLERANCES_MM", "RETURN_TOLERANCES",
}  # fmt: skip
SMALLEST_PLAIN_NUMBER = 1e-5
FLOAT_LIMITS = {"eps", "tiny", "smallest_normal", "epsilon"}


def test_no_epsilon_stands_outside_numerics():
    """Neither a tiny literal nor a limit of the floating-point format: a guard has one home, and its reason there."""
    bare = []
    for name, tree in trees().items():
        if name == "lidardesign.numerics":
            continue
        for statement in tree.body:
            targets = getattr(statement, "targets", None) or [getattr(statement, "target", None)]
            names = {node.id for target in targets if target for node in ast.walk(target) if isinstance(node, ast.Name)}
            if names & PHYSICAL_VALUES:
                continue
            for node in ast.walk(statement):
                size = abs(node.value) if isinstance(node, ast.Constant) and isinstance(node.value, float) else 0.0
                if 0 < size < SMALLEST_PLAIN_NUMBER:
                    bare.append(f"{name}:{node.lineno}: {node.value!r}")
                if isinstance(node, ast.Attribute) and node.attr in FLOAT_LIMITS:
                    bare.append(f"{name}:{node.lineno}: .{node.attr}")
    assert not bare


def test_no_test_imports_another_test():
    """What tests share is in tests/support, so that a test can be read, moved and dropped by itself."""
    folder = ROOT / "tests"
    texts = {path: path.read_text(encoding="utf-8") for path in folder.rglob("*.py")}
    imports = [
        f"{path.relative_to(folder)}: {node.module}"
        for path, text in texts.items()
        if re.search(r"\bfrom\s\S*test_", text)  # parsing takes longest
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and (node.module or "").rpartition(".")[2].startswith("test_")
    ]
    assert not imports


# Syntax nodes of every room when version 0.1 was finished, and of new ones; `contract` got formats and methods,
# `lidardesign` what shipped tasks import.
NODES = {
    "__main__": 56, "api": 17_552, "choices": 3_700, "cli": 26_596, "clouds": 4_134, "config": 3_471,
    "constraints": 16_438, "contract": 12_600, "density": 57_483, "errors": 1_276, "estimates": 2_020,
    "evaluation": 31_200, "fitting": 28_260, "formats": 36_217, "lidardesign": 560, "limits": 110, "methods": 16_900,
    "mixture": 23_217, "numerics": 2_847, "parts": 7_147, "plugins": 2_300, "problem": 1_750, "rays": 23_732,
    "report": 24_539, "run": 15_319, "run_folder": 1_282, "samples": 1_263, "scenes": 34_476, "scoring": 6_700,
    "sensors": 11_549, "simulate": 48_339, "space": 2_353, "studio": 13_663, "task": 2_387, "workers": 1_730,
}  # fmt: skip


def test_no_room_grows_by_more_than_a_tenth_from_one_version_to_the_next():
    """The CHANGELOG says what more buys."""
    nodes = collections.Counter()
    for name, tree in package().items():
        nodes[room(name) or "lidardesign"] += len(nodes_of(tree))
    assert {name: count for name, count in nodes.items() if count > 1.1 * NODES.get(name, 0)} == {}
