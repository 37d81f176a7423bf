"""The catalogue: the parts that are shipped, and a user's own files or folders of parts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from lidardesign.design.catalog.part import Part
from lidardesign.design.catalog.statements import PartFile
from lidardesign.errors import ConfigError
from lidardesign.run.clock import phase
from lidardesign.run.validation import check_model, suggest
from lidardesign.run.yaml import load_yaml

FOLDER = Path(__file__).parent / "parts"
SHIPPED = "lidardesign"
SUFFIX = ".yaml"
STEM = re.compile(r"[a-z0-9][a-z0-9._-]{0,60}")


@dataclass(frozen=True, eq=False)
class Library:
    """Parts by name.

    Arguments:
        files: The parts' files by the names of the parts.
        origins: Where each file is, `lidardesign` for what is shipped.
    """

    files: dict[str, PartFile]
    origins: dict[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the parts, without modes."""
        return sorted(self.files)

    def part(self, name: str) -> Part:
        """A part by `NAME` or `NAME:MODE`.

        Raises:
            ConfigError: There is no such part or mode.
        """
        stem, colon, mode = name.partition(":")
        if stem not in self.files:
            hint = (
                suggest(stem, self.files) or "lidardesign catalog list shows all, and a path names a file of your own"
            )
            raise ConfigError(f"there is no part {stem!r}", where="catalog", allowed=", ".join(self.names), hint=hint)
        file = self.files[stem]
        if colon and mode not in file.modes:
            allowed = ", ".join(file.modes) or f"{stem} alone: it has one mode"
            raise ConfigError(
                f"{stem} has no mode {mode!r}", where="catalog", allowed=allowed, hint=suggest(mode, file.modes)
            )
        return Part.of_file(stem, file, mode or None, self.origins[stem])

    def in_modes(self, name: str, mode: str = "") -> list[Part]:
        """A part in one mode, or in all that it has.

        Raises:
            ConfigError: There is no such part or mode.
        """
        modes = [mode] if mode else self.part(name).modes
        return [self.part(f"{name}:{one}") for one in modes] or [self.part(name)]

    def every_mode(self) -> list[Part]:
        """All parts in all their modes, by name."""
        return [part for name in self.names for part in self.in_modes(name)]


def load_library(own: Sequence[Path] = ()) -> Library:
    """The shipped parts and those of a user's files or folders, which stand in for shipped ones of the same name.

    Raises:
        ConfigError: A file or folder that cannot be read, holds no part, or says what is not possible; the message
            names file, line and column. Two own parts of one name.
    """
    files = dict(_shipped())
    origins = dict.fromkeys(files, SHIPPED)
    taken: dict[str, str] = {}
    paths: list[Path] = []
    for path in map(Path, own):
        inside = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
        if not inside:
            raise ConfigError(f"holds no file *{SUFFIX}", where=str(path), hint="docs/catalog.md shows a part file")
        paths += inside
    for path in paths:
        name = part_name(path)
        if name in taken:
            raise ConfigError(f"is a second part {name!r}", where=str(path), hint=f"the first is {taken[name]}")
        files[name] = read_part(path)
        taken[name] = origins[name] = str(path)
    return Library(files, origins)


def find_part(name_or_path: str | Path, own: Sequence[Path] = ()) -> Part:
    """A part by `NAME`, `NAME:MODE`, or the path of a part file, `FILE.yaml` or `FILE.yaml:MODE`.

    Raises:
        ConfigError: There is no such part, mode or file, or the file is no part file.
    """
    text = str(name_or_path)
    path, mode = (text, "") if text.endswith(SUFFIX) else text.rsplit(":", 1) if f"{SUFFIX}:" in text else ("", "")
    if not path:
        return load_library(own).part(text)
    file = Path(path)
    name = part_name(file)
    return load_library([*own, file]).part(f"{name}:{mode}" if mode else name)


@lru_cache(maxsize=1)
def _shipped() -> dict[str, PartFile]:
    return {path.stem: read_part(path) for path in sorted(FOLDER.glob(f"*{SUFFIX}"))}


def part_name(path: Path) -> str:
    """The name of the part in a file: the file's stem.

    Raises:
        ConfigError: A stem that could not be typed as a name.
    """
    if not STEM.fullmatch(path.stem):
        raise ConfigError(
            f"{path.stem!r} is no name of a part", where=str(path), allowed="a file name of a-z, 0-9, dot, dash, _"
        )
    return path.stem


@phase("catalog")
def read_part(path: Path) -> PartFile:
    """Read one part file.

    Raises:
        ConfigError: The file cannot be read or is no part file.
    """
    document = load_yaml(path)
    if not document.mapping:
        raise ConfigError("says nothing about a part", where=str(path), hint="docs/catalog.md shows a part file")
    return check_model(PartFile, document.mapping, document.locate)
