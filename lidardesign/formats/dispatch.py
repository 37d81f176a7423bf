"""Which reader a rig's file is for: its content decides, whatever it is called.

Files whose content is nothing of what their name says are refused with what is wrong, before YAML is tried.
"""

from __future__ import annotations

import codecs
import csv
import re
from pathlib import Path

from lidardesign.errors import DataError
from lidardesign.formats.mjcf import read_mjcf
from lidardesign.formats.ray_lists import (
    QUERY_COLUMN,
    SENSOR_COLUMNS,
    begins_as_sensor_csv,
    read_ray_csv,
    read_ray_npz,
)
from lidardesign.formats.rig import Rig, number_of
from lidardesign.formats.sdf import read_sdf
from lidardesign.run.xml import read_xml

CSV, NPZ, XML = "CSV", "NPZ", "XML"
KINDS = {".csv": CSV, ".npz": NPZ, ".xml": XML, ".mjcf": XML, ".sdf": XML, ".world": XML}
ALLOWED = {
    CSV: "a header in line 1 that names the columns, then one ray per line, separated by commas",
    NPZ: "an archive that numpy.savez or export --format npz writes",
    XML: "a MuJoCo model (<mujoco>) or an SDF file (<sdf>)",
}
XML_ROOTS = {"mujoco": read_mjcf, "sdf": read_sdf}
OTHER_ROOTS = {
    "robot": "URDF has no sensors of its own; give the SDF file of the simulation, or the rays as CSV",
    "mujocoinclude": "give the model that includes this file",
}
# An archive with members, and one without any.
ZIP_BEGINNINGS = (b"PK\x03\x04", b"PK\x05\x06")
# In UTF-16 with its mark the sign stands beside a zero byte.
XML_BEGINNINGS = (b"<", b"\xff\xfe<\x00", b"\xfe\xff\x00<")
UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# A mapping of YAML begins with a key, a document mark or a brace.
YAML_LINE = re.compile(r"(---|[{%\[]|- |['\"]?[A-Za-z_][\w ]*['\"]?\s*:(\s|$))")
SEPARATORS = {";": "; (a semicolon)", "\t": "tabs", "|": "| (a stroke)"}
HEADER_HINT = "as in origin_x_m,origin_y_m,origin_z_m,azimuth_deg,elevation_deg,gate_start_m,gate_end_m"


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
    _check_bytes(path, head)
    if head.removeprefix(codecs.BOM_UTF8).lstrip().startswith(XML_BEGINNINGS):
        tag = read_xml(path, ALLOWED[XML]).tag
        if tag not in XML_ROOTS:
            found, hint = f"its root element is {f'<{tag[:40]}>'!r}", OTHER_ROOTS.get(tag)
            raise DataError(found, where=str(path), allowed=ALLOWED[XML], hint=hint)
        return XML_ROOTS[tag](path)
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    texts = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    if not begins_as_sensor_csv(head):
        _check_text(path, texts)
        return None
    _, first = texts[0]
    # the commas may be those of numbers, between columns that something else separates
    separator = next((mark for mark in SEPARATORS if first.count(mark) >= max(first.count(","), 2)), None)
    if separator is not None:
        raise _wrong_separator(separator, f"{path}:1")
    cells = [cell.strip() for cell in next(csv.reader([first]))]
    if not any(cell in (*SENSOR_COLUMNS, QUERY_COLUMN) or number_of(cell) is not None for cell in cells):
        return read_ray_csv(path)
    # the research code's table begins with numbers, or with names of its columns
    if len(cells) not in (len(SENSOR_COLUMNS), len(SENSOR_COLUMNS) + 1) and not {*cells} & {*SENSOR_COLUMNS}:
        raise DataError(
            "line 1 has numbers and no names of columns", where=f"{path}:1", allowed=ALLOWED[CSV], hint=HEADER_HINT
        )
    return None


def _check_bytes(path: Path, head: bytes) -> None:
    """Refuse a file of a known name that is empty, or that is no text where it should be; it may be zipped."""
    kind = KINDS.get(path.suffix.lower())
    if kind is None or head.startswith(b"PK"):
        return
    if not head.strip():
        raise DataError("is empty", where=str(path), allowed=ALLOWED[kind])
    if head.startswith(UTF16_MARKS) and kind == XML:
        return
    try:
        # a letter may be cut at the end
        codecs.getincrementaldecoder("utf-8")().decode(head)
        is_text = True
    except UnicodeDecodeError:
        is_text = False
    if is_text and b"\0" not in head:
        return
    if kind == CSV and b"\0" not in head:
        raise DataError("is not UTF-8 text", where=str(path), allowed=ALLOWED[kind], hint="save it as UTF-8")
    found = {CSV: "is not CSV: it holds bytes that are not text", NPZ: "is not an NPZ archive", XML: "is not XML"}[kind]
    raise DataError(f"{found}, or is damaged", where=str(path), allowed=ALLOWED[kind])


def _check_text(path: Path, texts: list[tuple[int, str]]) -> None:
    """Refuse a text of a known name, as numbered lines, that neither its reader nor YAML takes."""
    kind = KINDS.get(path.suffix.lower())
    plain = next((line.strip() for _, line in texts if not line.strip().startswith("#")), "")
    if kind is None or YAML_LINE.match(plain):
        return
    where = f"{path}:{texts[0][0]}" if texts else str(path)
    if kind != CSV:
        raise DataError(
            "is not an NPZ archive, but text" if kind == NPZ else "is not XML: it does not begin with <",
            where=where,
            allowed=ALLOWED[kind],
        )
    if texts and texts[0][1].strip().startswith("#"):
        raise DataError("begins with a comment", where=where, allowed=ALLOWED[kind], hint="leave out lines with #")
    separator = next((mark for mark in SEPARATORS if mark in plain), None)
    if separator is not None:
        raise _wrong_separator(separator, where)
    raise DataError("has no columns", where=where, allowed=ALLOWED[kind], hint=HEADER_HINT)


def _wrong_separator(separator: str, where: str) -> DataError:
    found, hint = f"columns are separated by {SEPARATORS[separator]}", "save it with commas, and with points in numbers"
    return DataError(found, where=where, allowed=ALLOWED[CSV], hint=hint)
