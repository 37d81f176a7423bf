"""Which reader a file is for, told by its content.

Files whose content is nothing of what their name says: what is wrong with them, said before YAML is tried.

The content decides what a file is, so a text that another reader takes is left to that, whatever it is called.
"""

from __future__ import annotations

import codecs
import csv
import re
from pathlib import Path

from lidardesign.design.rigs.mjcf import read_mjcf
from lidardesign.design.rigs.ray_lists import read_ray_csv, read_ray_npz
from lidardesign.design.rigs.rig import Rig
from lidardesign.design.rigs.sdf import read_sdf
from lidardesign.design.rigs.sensor_csv import COLUMNS, QUERY_COLUMN, looks_like_sensor_csv
from lidardesign.errors import DataError
from lidardesign.run.xml import read_xml

CSV, NPZ, XML = "CSV", "NPZ", "XML"
KINDS = {".csv": CSV, ".npz": NPZ, ".xml": XML, ".mjcf": XML, ".sdf": XML, ".world": XML}
ALLOWED = {
    CSV: "a header in line 1 that names the columns, then one ray per line, separated by commas",
    NPZ: "an archive that numpy.savez or export --format npz writes",
    XML: "a MuJoCo model (<mujoco>) or an SDF file (<sdf>)",
}
UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# A mapping of YAML begins with a key, a document mark or a brace.
YAML_LINE = re.compile(r"(---|[{%\[]|- |['\"]?[A-Za-z_][\w ]*['\"]?\s*:(\s|$))")
SEPARATORS = {";": "; (a semicolon)", "\t": "tabs", "|": "| (a stroke)"}
HEADER_HINT = "as in origin_x_m,origin_y_m,origin_z_m,azimuth_deg,elevation_deg,gate_start_m,gate_end_m"


def check_bytes(path: Path, head: bytes) -> None:
    """Refuse a file of a known name that is empty, or that is no text where it should be.

    Arguments:
        path: The file.
        head: Its first bytes.

    Raises:
        DataError: See above; a zipped file is none of this.
    """
    kind = KINDS.get(path.suffix.lower())
    if kind is None or head.startswith(b"PK"):
        return
    if not head.strip():
        raise DataError("is empty", where=str(path), allowed=ALLOWED[kind])
    if head.startswith(UTF16_MARKS) and kind == XML:
        return
    if b"\0" in head or not _is_text(head):
        if kind == CSV and b"\0" not in head:
            raise DataError("is not UTF-8 text", where=str(path), allowed=ALLOWED[kind], hint="save it as UTF-8")
        found = {CSV: "is no CSV: it holds bytes that no text has", NPZ: "is no NPZ archive", XML: "is no XML"}[kind]
        raise DataError(f"{found}, or is damaged", where=str(path), allowed=ALLOWED[kind])


def check_text(path: Path, head: bytes) -> None:
    """Refuse a text of a known name that neither its reader nor YAML takes.

    Raises:
        DataError: See above.
    """
    kind = KINDS.get(path.suffix.lower())
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    told = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
    plain = next((line for _, line in told if not line.startswith("#")), "")
    if kind is None or YAML_LINE.match(plain):
        return
    where = f"{path}:{told[0][0]}" if told else str(path)
    if kind != CSV:
        found = "is no NPZ archive, but text" if kind == NPZ else "is no XML: it does not begin with <"
        raise DataError(found, where=where, allowed=ALLOWED[kind])
    if told and told[0][1].startswith("#"):
        raise DataError("begins with a comment", where=where, allowed=ALLOWED[kind], hint="leave out lines with #")
    separator = next((mark for mark in SEPARATORS if mark in plain), None)
    if separator is not None:
        hint = "save it with commas, and with points in numbers"
        raise DataError(
            f"columns are separated by {SEPARATORS[separator]}", where=where, allowed=ALLOWED[kind], hint=hint
        )
    raise DataError("has no columns", where=where, allowed=ALLOWED[kind], hint=HEADER_HINT)


def check_separator(path: Path, head: bytes) -> None:
    """Refuse a text whose commas are those of its numbers, between columns that something else separates.

    Raises:
        DataError: See above.
    """
    first = next(line for line in head.decode("utf-8-sig", errors="replace").splitlines() if line.strip())
    separator = next((mark for mark in SEPARATORS if first.count(mark) >= max(first.count(","), 2)), None)
    if separator is not None:
        hint = "save it with commas, and with points in numbers"
        raise DataError(
            f"columns are separated by {SEPARATORS[separator]}", where=f"{path}:1", allowed=ALLOWED[CSV], hint=hint
        )


def refuse_headless(path: Path) -> DataError:
    """What is said of rays without names of their columns."""
    return DataError(
        "line 1 has numbers and no names of columns", where=f"{path}:1", allowed=ALLOWED[CSV], hint=HEADER_HINT
    )


def _is_text(head: bytes) -> bool:
    """Whether bytes are UTF-8; a letter may be cut at their end."""
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False
    return True


# An archive with members, and one without any.
ZIP_BEGINNINGS = (b"PK\x03\x04", b"PK\x05\x06")
XML_ROOTS = {"mujoco": read_mjcf, "sdf": read_sdf}
XML_ALLOWED = "a MuJoCo model (<mujoco>) or an SDF file (<sdf>)"
OTHER_ROOTS = {
    "robot": "URDF holds no sensors of its own; give the SDF file of the simulation, or the rays as CSV",
    "mujocoinclude": "give the model that includes this file",
}


def read_rig(path: Path, head: bytes) -> Rig | None:
    """The rig that a file describes; None where it is a design file or the research code's sensor table.

    Arguments:
        path: The file.
        head: Its first bytes.

    Raises:
        DataError: It is a rig's file that cannot be used.
    """
    if head.startswith(ZIP_BEGINNINGS):
        return read_ray_npz(path)
    check_bytes(path, head)
    if _begins_as_xml(head):
        return _read_xml_rig(path)
    if not looks_like_sensor_csv(head):
        check_text(path, head)
        return None
    check_separator(path, head)
    cells = _first_cells(head)
    if not any(cell in (*COLUMNS, QUERY_COLUMN) or _is_number(cell) for cell in cells):
        return read_ray_csv(path)
    if len(cells) not in (len(COLUMNS), len(COLUMNS) + 1) and not {*cells} & {*COLUMNS}:
        raise refuse_headless(path)
    return None


def _begins_as_xml(head: bytes) -> bool:
    # UTF-16 with its mark has the sign beside a zero byte
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith((b"<", b"\xff\xfe<\x00", b"\xfe\xff\x00<"))


def _first_cells(head: bytes) -> list[str]:
    """The cells of a CSV's first line; the research code's begins with numbers, or with names of its columns."""
    text = head.decode("utf-8-sig", errors="replace")
    first = next(line for line in text.splitlines() if line.strip())
    return [cell.strip() for cell in next(csv.reader([first]))]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _read_xml_rig(path: Path) -> Rig:
    tag = read_xml(path, XML_ALLOWED).tag
    if tag not in XML_ROOTS:
        shown = repr(f"<{tag[:40]}>")
        raise DataError(f"its root element is {shown}", where=str(path), allowed=XML_ALLOWED, hint=OTHER_ROOTS.get(tag))
    return XML_ROOTS[tag](path)
