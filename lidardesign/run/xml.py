"""XML as a tree whose elements know their lines, read without following anything outside the text.

Document types are refused, and with them every entity: nothing is fetched, and nothing expands.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.parsers import expat

from lidardesign.errors import DataError
from lidardesign.run.inputs import XML, read_file
from lidardesign.run.yaml import plain_number

DEEPEST = 200
MOST_ELEMENTS = 500_000
LONGEST_QUOTE = 80
# The parser hands text over in pieces of so much, not line by line: each is joined to what already exists.
PIECE_BYTES = 1 << 20
# Messages of the parser at the end of a truncated file.
CUT_SHORT = frozenset(
    expat.errors.codes[text]
    for text in (
        expat.errors.XML_ERROR_NO_ELEMENTS,
        expat.errors.XML_ERROR_UNCLOSED_TOKEN,
        expat.errors.XML_ERROR_PARTIAL_CHAR,
        expat.errors.XML_ERROR_UNCLOSED_CDATA_SECTION,
    )
)


class Element(ElementTree.Element):
    """An element with the line on which it begins."""

    line: int = 0


def read_xml(path: Path, allowed: str, *, most_elements: int = MOST_ELEMENTS) -> Element:
    """The root element of a file.

    Raises:
        DataError: The file cannot be read, is too large, is not XML, has a document type, or is nested too deep.
    """
    content = read_file(path, XML, allowed=allowed)
    builder = _Builder(path, most_elements)
    try:
        return builder.build(content)
    except expat.ExpatError as error:
        position = f"{path}:{error.lineno}:{error.offset + 1}"
        if error.code in CUT_SHORT:
            raise DataError(builder.unfinished, where=position, allowed=allowed, hint="it may be cut short") from None
        raise DataError(f"is not XML: {expat.ErrorString(error.code)}", where=position, allowed=allowed) from None
    except (LookupError, ValueError) as error:
        raise DataError(f"is not XML: {error}", where=str(path), allowed=allowed) from None


class _Builder:
    """Builds the tree from the parser's events."""

    def __init__(self, path: Path, most_elements: int = MOST_ELEMENTS) -> None:
        self._path, self._count, self._most = path, 0, most_elements
        # the root stays below the elements that are open
        self._open: list[Element] = []
        self._parser = expat.ParserCreate()
        self._parser.buffer_text, self._parser.buffer_size = True, PIECE_BYTES
        self._parser.StartDoctypeDeclHandler = self._doctype
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._text

    def build(self, content: bytes) -> Element:
        self._parser.Parse(content, True)
        return self._open[0]

    @property
    def unfinished(self) -> str:
        """The error text for a file that ends too early."""
        if not self._open:
            return "is not XML, or ends early: it has no element"
        last = self._open[-1]
        return f"ends early: <{last.tag[:LONGEST_QUOTE]}> of line {last.line} is not closed"

    def _doctype(self, *_: object) -> None:
        raise DataError(
            "has a document type",
            where=f"{self._path}:{self._parser.CurrentLineNumber}",
            allowed="plain XML: entities are not read",
        )

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._count += 1
        if len(self._open) >= DEEPEST or self._count > self._most:
            raise DataError(
                "is nested too deep or has too many elements",
                where=f"{self._path}:{self._parser.CurrentLineNumber}",
                allowed=f"{DEEPEST} levels, {self._most} elements",
            )
        element = Element(tag, attributes)
        element.line = self._parser.CurrentLineNumber
        if self._open:
            self._open[-1].append(element)
        self._open.append(element)

    def _end(self, _: str) -> None:
        if len(self._open) > 1:
            self._open.pop()

    def _text(self, text: str) -> None:
        element = self._open[-1]
        if not len(element):
            element.text = (element.text or "") + text


def numbers_of(text: str | None, count: int, where: str, name: str) -> list[float]:
    """`count` finite numbers from a text, separated by blanks.

    Raises:
        DataError: Another count, or a part that is no finite number.
    """
    try:
        values = [plain_number(part) for part in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(math.isfinite(value) for value in values):
        shown = repr((text or "").strip()[:LONGEST_QUOTE])
        raise DataError(
            f"{name} is {shown}", where=where, allowed="a finite number" if count == 1 else f"{count} finite numbers"
        )
    return values
