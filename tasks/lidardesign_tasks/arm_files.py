"""Which files an MJCF model reads: all of them must lie in the model's own folder."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from lidardesign.errors import DataError

LARGEST_XML_BYTES = 16_000_000
DIRECTORIES = ("meshdir", "texturedir", "assetdir")
MAX_INCLUDES = 100

FileState = tuple[str, int, int]


def model_files(path: Path) -> tuple[FileState, ...]:
    """Name, time of change [ns] and size of every file of an MJCF model, the XML files first.

    Raises:
        DataError: A file is missing, unreadable, no MJCF, or lies outside the model's folder.
    """
    folder = path.resolve().parent
    documents, assets, directories = [path.resolve()], [], {""}
    for document in documents:  # grows while included files are found
        if len(documents) > MAX_INCLUDES:
            raise DataError(f"includes more than {MAX_INCLUDES} files", where=str(path))
        root = _parse(document)
        if document == documents[0] and root.tag != "mujoco":
            raise DataError(f"its root element is <{root.tag}>", where=str(path), allowed="<mujoco>, an MJCF model")
        for element in root.iter():
            directories |= {element.get(name, "") for name in DIRECTORIES if element.tag == "compiler"}
            names = [value for key, value in element.attrib.items() if key == "file" or key.startswith("file")]
            if element.tag in ("include", "model"):
                documents += [found for name in names if (found := _inside(folder, "", name, path)) not in documents]
            else:
                assets += [name for name in names if name]
    found = {_inside(folder, directory, name, path) for directory in directories for name in assets}
    for directory in directories:
        _inside(folder, directory, "", path)
    return tuple(_state(file) for file in [*documents, *sorted(found)] if file.is_file())


def _inside(folder: Path, directory: str, name: str, model: Path) -> Path:
    """The file that a model names, links followed; absolute names and parents lead out of its folder."""
    found = (folder / directory / name).resolve()
    if not found.is_relative_to(folder):
        raise DataError(
            f"reads {(Path(directory) / name).as_posix()!r}, which is outside the model's folder",
            where=str(model),
            hint="copy the file into the model's folder and name it from there",
        )
    return found


def _parse(path: Path) -> ElementTree.Element:
    try:
        if path.exists() and not path.is_file():
            raise DataError("is no regular file", where=str(path), allowed="an MJCF model")
        if path.stat().st_size > LARGEST_XML_BYTES:
            raise DataError(f"has {path.stat().st_size} bytes", where=str(path), allowed=f"{LARGEST_XML_BYTES}")
        return ElementTree.fromstring(path.read_bytes())
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror})", where=str(path), allowed="an MJCF model") from error
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise DataError(f"is no XML ({error})", where=str(path), allowed="an MJCF model") from error


def _state(path: Path) -> FileState:
    state = path.stat()
    return str(path), state.st_mtime_ns, state.st_size
