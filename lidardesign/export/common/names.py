"""Names as other programs take them, and folders of files: each is whole or absent."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from lidardesign.errors import DataError
from lidardesign.run.files import write_atomic

# Of what a name becomes; topics and prim paths are built of several.
LONGEST_NAME = 64
# So many changed names are quoted in a note.
QUOTED = 3
# Names of SDF's and MuJoCo's own frame, and xacro's own macros.
RESERVED = {
    "world", "arg", "attribute", "call", "element", "else", "if", "include", "insert_block", "macro", "property",
    "unless",
}  # fmt: skip
# What XML 1.0 cannot hold, not even escaped.
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def identifier(name: str) -> str:
    """A name of letters, digits and underscores that begins with a letter; accents are dropped.

    No underscore follows another or ends it: such names are reserved in SDF and in ROS, as are some words.
    """
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    word = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")[:LONGEST_NAME].rstrip("_")
    plain_word = word[:1].isalpha() and word.lower() not in RESERVED
    return word if plain_word else f"s_{word}".rstrip("_")


def identifiers(names: Sequence[str]) -> list[str]:
    """An identifier of each name, no two alike, whatever their case."""
    return distinct([identifier(name) for name in names], "_")


def distinct(names: Sequence[str], between: str, taken: Iterable[str] = ()) -> list[str]:
    """Names, no two alike whatever their case, nor like one that is taken: the next number follows where they are.

    Arguments:
        names: The names.
        between: What stands between a name and its number.
        taken: Names that none may have.
    """
    used = {name.lower() for name in taken}
    numbers: dict[str, int] = {}
    found = []
    for name in names:
        chosen = name
        while chosen.lower() in used:
            numbers[name] = numbers.get(name, 1) + 1
            chosen = f"{name}{between}{numbers[name]}"
        used.add(chosen.lower())
        found.append(chosen)
    return found


def renamed_note(names: Sequence[str], written: Sequence[str]) -> list[str]:
    """A note of the names that had to change, if any."""
    changed = [(old, new) for old, new in zip(names, written, strict=True) if old != new]
    if not changed:
        return []
    shown = ", ".join(f"{old!r} is {new}" for old, new in changed[:QUOTED])
    more = f", and {len(changed) - QUOTED} more" if len(changed) > QUOTED else ""
    return [f"names are letters, digits and underscores there: {shown}{more}"]


def xml_text(text: str) -> str:
    """Text that XML can hold once it is escaped: characters that it cannot become U+FFFD."""
    return _NOT_XML.sub("\ufffd", text)


# So many names of other files are told, the rest is counted.
MOST_NAMED = 5


def write_folder(path: Path, files: Mapping[str, bytes]) -> list[str]:
    """Write a folder of files, each atomically; returns a note where it also holds others, as of an earlier export.

    Raises:
        DataError: There is a file of that name, or the system reports anything else.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise DataError(
            "is a file, and this format is a folder of files", where=str(path), hint="give the name of a folder"
        )
    for name, content in files.items():
        write_atomic(path / name, content)
    others = sorted(entry.name for entry in path.iterdir() if entry.name not in files and entry.name[0] != ".")
    if not others:
        return []
    named = ", ".join(others[:MOST_NAMED]) + (", ..." if len(others) > MOST_NAMED else "")
    return [f"the folder also holds {len(others)} other files, which stay as they are: {named}"]
