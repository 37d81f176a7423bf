"""Writing XML files, escaped by the standard library, and reading back those that were written."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element

from lidardesign.errors import DataError
from lidardesign.export.common.names import xml_text
from lidardesign.run import xml
from lidardesign.run.files import write_atomic

# A million rays of some 300 bytes.
MOST_BYTES = 1_000_000_000


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


def write_xml(path: Path, root: Element) -> None:
    """Write a document, indented, atomically.

    Raises:
        DataError: The file cannot be written.
    """
    write_atomic(path, document(root))


def read_xml(path: Path, tag: str) -> Element:
    """The root of a document that `write_xml` wrote.

    Raises:
        DataError: It cannot be read, is no such document, or declares a document type.
    """
    root = xml.read_xml(path, f"a <{tag}> document", largest_bytes=MOST_BYTES, most_elements=MOST_BYTES)
    if root.tag != tag:
        raise DataError(f"is no <{tag}> document but a <{root.tag[:40]}>", where=str(path))
    return root
