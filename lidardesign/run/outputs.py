"""Checks of a command's output files before its work: they can be written, and overwrite nothing else."""

from __future__ import annotations

import contextlib
import itertools
import os
import stat
import tempfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

from lidardesign.errors import ConfigError, DataError
from lidardesign.run.files import FILE_NAME as LOCK
from lidardesign.run.inputs import parse_json
from lidardesign.run.manifest import FILE_NAME as MANIFEST

# The cache of information of rays about training scenes.
CACHE = "informed.npz"
# Files of a run that its manifest does not list.
RUN_FILES = (MANIFEST, LOCK, CACHE, "config.yaml", "progress.jsonl")
STREAMS = {1: "standard output", 2: "standard error"}
# A full disk has room for an empty file.
TRIAL = bytes(1024)
ELSEWHERE = "give another place"


def check_outputs(
    outputs: Mapping[str, Path | None], inputs: Iterable[Path | str] = (), folders: Collection[str] = ()
) -> None:
    """Refuse outputs that cannot be written, or that would overwrite inputs or files of a run.

    Arguments:
        outputs: Output paths by their options; None is left out.
        inputs: Files that the command reads.
        folders: The options whose output is a folder of files.

    Raises:
        ConfigError: Two are one file, or one is an input, a file of a run, or where standard output goes.
        DataError: One cannot be written.
    """
    places = {name: Path(path) for name, path in outputs.items() if path is not None}
    files = {name: path for name, path in places.items() if name not in folders}
    inputs = [Path(path) for path in inputs]
    for name, path in places.items():
        check_writable(path, is_folder=name in folders)
    for name, path in files.items():
        _check_replaced(name, path, inputs)
    for (name, path), (other, place) in itertools.permutations(places.items(), 2):
        # of what is there, neither file nor folder is a device or a pipe
        is_device = path.exists() and not path.is_file() and not path.is_dir()
        if name in files and not is_device and place.resolve().is_relative_to(path.resolve()):
            what = "the same file" if place.resolve() == path.resolve() else f"a folder of {other} too"
            raise ConfigError(f"{path} is {what}", where=f"{name} and {other}", hint=ELSEWHERE)


def _check_replaced(name: str, path: Path, inputs: Iterable[Path]) -> None:
    """Refuse an existing file that is an input, belongs to a run, or receives this process's output."""
    if not path.is_file():
        return
    for stream, words in STREAMS.items():
        with contextlib.suppress(OSError):
            if os.path.samestat(os.fstat(stream), path.stat()):
                raise ConfigError(f"{path} is where {words} goes", where=name, hint=ELSEWHERE)
    if any(read.is_file() and read.samefile(path) for read in inputs):
        raise ConfigError(f"{path} is an input, and would be overwritten", where=name, hint=ELSEWHERE)
    for folder in path.resolve().parents[:2]:
        if (folder / MANIFEST).is_file() and path.resolve().relative_to(folder).as_posix() in files_of_run(folder):
            raise ConfigError(f"{path} is a file of the run {folder}", where=name, hint=ELSEWHERE)


def files_of_run(run: Path) -> set[str]:
    """The names of the files of a run; of one with a damaged manifest only the usual ones."""
    with contextlib.suppress(OSError, ValueError, AttributeError, TypeError):
        return {*RUN_FILES, *parse_json((run / MANIFEST).read_bytes()).get("files", ())}
    return {*RUN_FILES}


def check_writable(path: Path, *, is_folder: bool = False) -> None:
    """Refuse a place that cannot be written, by writing a small unnamed file there.

    Arguments:
        path: The file or folder; folders above it may be missing.
        is_folder: Whether it is to be a folder of files.

    Raises:
        DataError: A file stands where a folder would be, a folder where a file would, or the system refuses to write.
    """
    path = Path(path)
    try:
        found = _look_up(path)
        if found is not None and stat.S_ISDIR(found.st_mode) != is_folder:
            what, hint = (
                ("file", "a new folder, or one that is there") if is_folder else ("folder", "the name of a file")
            )
            raise DataError(f"is a {what}", where=str(path), hint=f"give {hint}")
        if found is not None and not (is_folder or stat.S_ISREG(found.st_mode)):
            if not (stat.S_ISFIFO(found.st_mode) or stat.S_ISCHR(found.st_mode)) or not os.access(path, os.W_OK):
                raise DataError("cannot be written", where=str(path), allowed="a file, a pipe or a character device")
            return
        # writing follows links
        place = Path(os.path.realpath(path))
        there = next(folder for folder in ([place] if is_folder else []) + [*place.parents] if _look_up(folder))
        if not there.is_dir():
            raise DataError(f"cannot be created: {there} is a file", where=str(path), hint=ELSEWHERE)
        for part in place.relative_to(there).parts:
            _look_up(there / part)  # a name may be too long
        with tempfile.TemporaryFile(dir=there) as trial:  # it has no name: no kill leaves it behind
            trial.write(TRIAL)
            trial.flush()
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f"cannot be written: {reason}", where=str(path), hint=ELSEWHERE) from None


def _look_up(path: Path) -> os.stat_result | None:
    """The `stat` of a path; None where nothing is there."""
    try:
        return os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
