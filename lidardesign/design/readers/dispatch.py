"""Which reader a file is for, told by its content."""

from __future__ import annotations

import csv
from pathlib import Path

from lidardesign.design.readers.faults import check_bytes, check_separator, check_text, refuse_headless
from lidardesign.design.readers.mjcf import read_mjcf
from lidardesign.design.readers.ray_csv import read_ray_csv
from lidardesign.design.readers.ray_npz import read_ray_npz
from lidardesign.design.readers.rig import Rig
from lidardesign.design.readers.sdf import read_sdf
from lidardesign.design.readers.xml_text import read_xml
from lidardesign.design.sensor_csv import COLUMNS, QUERY_COLUMN, looks_like_sensor_csv
from lidardesign.errors import DataError

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
