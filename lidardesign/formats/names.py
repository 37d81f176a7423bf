"""Names, folders and XML for files of other programs."""

from __future__ import annotations

import re
import unicodedata
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from xml.etree.ElementTree import Element

# Longest identifier; topics and prim paths are built of several.
LONGEST_NAME = 64
# Most changed names quoted in a note.
QUOTED = 3
# Names of SDF's and MuJoCo's own frame, and xacro's own macros.
RESERVED = {
    "world", "arg", "attribute", "call", "element", "else", "if", "include", "insert_block", "macro", "property",
    "unless",
}  # fmt: skip
# Characters that XML 1.0 cannot hold, not even escaped.
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def identifier(name: str) -> str:
    """A name of letters, digits and underscores that begins with a letter; accents are dropped.

    No underscore follows another or ends it: such names are reserved in SDF and in ROS, as are some words.
    """
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    word = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")[:LONGEST_NAME].rstrip("_")
    return word if (word[:1].isalpha() and word.lower() not in RESERVED) else f"s_{word}".rstrip("_")


def distinct(names: Sequence[str], between: str, taken: Iterable[str] = ()) -> list[str]:
    """Names made distinct regardless of case, and from taken ones, by appended numbers.

    Arguments:
        names: The names.
        between: Text between a name and its number.
        taken: Names that are not available.
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
    shown = ", ".join(f"{old!r} became {new}" for old, new in changed[:QUOTED])
    more = f", and {len(changed) - QUOTED} more" if len(changed) > QUOTED else ""
    return [f"names there hold only letters, digits and underscores: {shown}{more}"]


def xml_text(text: str) -> str:
    """Text that XML can hold once it is escaped: characters that it cannot become U+FFFD."""
    return _NOT_XML.sub("\ufffd", text)


def element(
    tag: str, attributes: Mapping[str, object] | None = None, children: Iterable[Element] = (), text: object = None
) -> Element:
    """XML element with attributes, children and text; numbers have all digits, invalid characters are replaced."""
    made = Element(tag, {name: _plain(value) for name, value in (attributes or {}).items()})
    made.text = None if text is None else _plain(text)
    made.extend(children)
    return made


def numbers(values: Iterable[float]) -> str:
    """Numbers with all their digits, separated by spaces."""
    return " ".join(repr(float(value)) for value in values)


def child(parent: Element, tag: str, text: object = None, **attributes: object) -> Element:
    """An element at the end of its parent."""
    made = element(tag, attributes, text=text)
    parent.append(made)
    return made


def _plain(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return numbers([value]) if isinstance(value, float) else xml_text(str(value))


def document(root: Element) -> bytes:
    """Content of an XML file: the declaration, then the root, indented."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True) + b"\n"
