"""Names, folders and XML as other programs take them."""

from __future__ import annotations

import re
import unicodedata
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

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
    return word if (word[:1].isalpha() and word.lower() not in RESERVED) else f"s_{word}".rstrip("_")


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
    return [f"names there are letters, digits and underscores: {shown}{more}"]


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


def element(
    tag: str, attributes: Mapping[str, str] | None = None, children: Iterable[Element] = (), text: str | None = None
) -> Element:
    """An element of its attributes, children and text, all of which may be any text."""
    made = Element(tag, {name: xml_text(value) for name, value in (attributes or {}).items()})
    made.text = None if text is None else xml_text(text)
    made.extend(children)
    return made


def number(value: float) -> str:
    """A number with all its digits, as XML formats take it."""
    return repr(float(value))


def numbers(values: Iterable[float]) -> str:
    """Numbers with all their digits, separated by spaces."""
    return " ".join(map(number, values))


def child(parent: Element, tag: str, text: object = None, **attributes: object) -> Element:
    """An element at the end of its parent; numbers are written with all their digits."""
    made = element(tag, {name: _plain(value) for name, value in attributes.items()})
    made.text = None if text is None else xml_text(_plain(text))
    parent.append(made)
    return made


def _plain(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return number(value) if isinstance(value, float) else str(value)


def document(root: Element) -> bytes:
    """The content of a file: the declaration, then the root, indented."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"
