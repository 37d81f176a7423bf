"""A new task as an installable package, written from templates, which keeps the contract unchanged."""

from __future__ import annotations

import re
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path

from lidardesign import __version__
from lidardesign.errors import ConfigError, DataError, page
from lidardesign.run.files import is_temporary, write_folder
from lidardesign.run.inputs import UNFINISHED, unfinished_names
from lidardesign.task import API_VERSION, TASKS

NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
LONGEST_NAME = 30
# Templates by the file that they become; names of files have the same tokens as their contents.
FILES = {
    "pyproject.toml": "pyproject.toml.txt",
    "README.md": "README.md.txt",
    ".gitignore": "gitignore.txt",
    ".github/workflows/test.yml": "ci.yml.txt",
    "@@module@@/__init__.py": "init.py.txt",
    "@@module@@/config.py": "config.py.txt",
    "@@module@@/task.py": "task.py.txt",
    "tests/test_contract.py": "test_contract.py.txt",
    "tests/test_task.py": "test_task.py.txt",
}


def new_task(name: str, folder: Path | None = None) -> list[Path]:
    """Write the package of a new task.

    Arguments:
        name: The task's name, as `learn` will take it.
        folder: A new or empty folder; None: lidardesign-NAME in the working folder.

    Returns:
        The files that were written.

    Raises:
        ConfigError: The name cannot be one, or is taken.
        DataError: The folder holds something, or cannot be written.
    """
    if not NAME.fullmatch(name) or len(name) > LONGEST_NAME:
        raise ConfigError(
            f"{name!r} is not a name for a task",
            where="NAME",
            allowed=f"small letters, digits and single underscores, up to {LONGEST_NAME}, such as landmark or "
            "drone_landing",
        )
    if name in TASKS.names():
        raise ConfigError(f"a task {name!r} is installed already", where="NAME", hint="choose another name")
    if find_spec(f"lidardesign_{name}") is not None:
        raise ConfigError(f"a module lidardesign_{name} is installed already", where="NAME", hint="choose another name")
    tokens = {
        "name": name,
        "package": f"lidardesign-{name.replace('_', '-')}",
        "module": f"lidardesign_{name}",
        "class": "".join(part.capitalize() for part in name.split("_")),
        "version": __version__,
        "api_version": str(API_VERSION),
    }
    folder = Path(tokens["package"]) if folder is None else folder
    # what a killed one left is gone on with
    held = [one.name for one in folder.glob("*") if not is_temporary(one.name) and one.name != UNFINISHED]
    if (folder.exists() and not folder.is_dir()) or (held and not unfinished_names(folder)):
        raise DataError("already exists", where=str(folder), allowed="a new or an empty folder", hint="--out DIR")
    written = {
        _filled(target, tokens): _filled(
            (files(__package__) / "template" / template).read_text(encoding="utf-8"), tokens
        ).encode()
        for target, template in FILES.items()
    }
    written["constraints.txt"] = page("constraints.txt").read_bytes()
    write_folder(folder, written)
    return [folder / name for name in written]


def _filled(text: str, tokens: dict[str, str]) -> str:
    return re.sub(r"@@(\w+)@@", lambda found: tokens[found[1]], text)
