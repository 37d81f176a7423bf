"""Designs from files: design files, the research code's tables, and rigs of others, told apart by their content.

Files whose content is nothing of what their name says are refused with what is wrong, before YAML is tried.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, DataError, LidardesignError
from lidardesign.formats.mjcf import read_mjcf
from lidardesign.formats.ray_lists import (
    QUERY_COLUMN,
    SENSOR_COLUMNS,
    begins_as_sensor_csv,
    read_ray_csv,
    read_ray_npz,
    read_sensor_csv,
)
from lidardesign.formats.rig import Rig, number_of, rig_design
from lidardesign.formats.sdf import read_sdf
from lidardesign.run.clock import phase
from lidardesign.run.inputs import DESIGN, RAY_TABLE, read_head
from lidardesign.run.manifest import changed_since_recorded
from lidardesign.run.xml import read_xml
from lidardesign.run.yaml import KeyPath, load_yaml
from lidardesign.run_folder import DESIGN_FOLDER, MANIFEST, Notes, RunFolder, log_note
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_from_document
from lidardesign.space import RANGE

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


@phase("designs")
def load_design(path: Path, reach_m: float | None = None) -> DesignSpec:
    """Read a design from a design file, the research code's sensor CSV or a rig of others.

    The design takes the file's stem as its name, as tables name designs by their files.

    Arguments:
        path: The file.
        reach_m: How far the rays of a rig are heard where its file does not say so [m].

    Raises:
        DataError: The file cannot be read, or a CSV, an NPZ or an XML file holds what cannot be used (exit 3).
        ConfigError: The file is not YAML, or not a design (exit 2).
    """
    path = Path(path)
    head = read_head(path, RAY_TABLE, hint="give a design file, as RUN/designs/NAME.yaml")
    rig = read_rig(path, head)
    if rig is not None:
        return rig_design(rig, path, reach_m)
    if begins_as_sensor_csv(head):
        return read_sensor_csv(path)
    document = load_yaml(path, DESIGN)
    design = design_from_document(document.value, str(path), document.locate)

    def locate(keys: KeyPath, *, key: bool = False) -> str:
        return document.locate(("constraints", *keys), key=key)

    Constraints.from_mapping(design.constraints, where=str(path), locate=locate)
    return replace(design, name=path.stem)


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


def read_design(path: Path, notes: Notes = log_note, reach_m: float | None = None) -> DesignSpec:
    """A design file or a rig of others.

    One of a run that is not as it was written says so: it may be cut, or mended by hand. A rig says what its file
    does not.

    Arguments:
        path: The file.
        notes: Called with every note.
        reach_m: How far the rays of a rig are heard where its file does not say so [m].

    Raises:
        ConfigError, DataError: It cannot be read.
    """
    difference = _difference(path)
    try:
        design = load_design(path, reach_m)
    except (ConfigError, DataError) as error:
        if difference is None:
            raise
        hint = f"the file {difference}; fit it again, or correct it"
        raise type(error)(error.message, where=error.where, allowed=error.allowed, hint=hint) from None
    if difference is not None:
        notes(f"{path} {difference}")
    # only what was read from others has notes
    further = design.provenance.get("notes") if "source" in design.provenance else None
    for note in further if isinstance(further, list) else ():
        notes(f"{path}: {note}")
    return design


def _difference(path: Path) -> str | None:
    """In what a design differs from the one that its run's manifest has, where it lies in a run."""
    folder, run = path.absolute().parent, path.absolute().parent.parent
    if folder.name == DESIGN_FOLDER and path.is_file() and (run / MANIFEST).is_file():
        with contextlib.suppress(DataError):  # whatever needs the manifest says that it is damaged
            return changed_since_recorded(run, f"{DESIGN_FOLDER}/{path.name}")
    return None


def open_target(path: Path, notes: Notes = log_note) -> tuple[RunFolder | None, DesignSpec | None]:
    """Open a run folder, or a design file and the run that it came from.

    Returns:
        (run, None) for a folder, (run or None, design) for a file.

    Raises:
        DataError: There is no such file or folder, or it cannot be read.
    """
    if path.is_dir():
        return RunFolder.open(path), None
    if not path.exists():
        raise DataError("no such run or design", where=str(path), hint="give a run folder or a design file")
    design = read_design(path, notes)
    return run_of(design, path), design


def run_of(design: DesignSpec, path: Path) -> RunFolder | None:
    """The run that a design came from, if it is there."""
    folder = folder_of(design, path)
    return None if folder is None else RunFolder.open(folder)


def folder_of(design: DesignSpec, path: Path) -> Path | None:
    """The folder of the run that a design came from, if it is there: its provenance names it relative to its file."""
    named = design.provenance.get("run")
    folder = Path(os.path.normpath(path.parent / named)) if isinstance(named, str) else None
    # a design that was copied elsewhere names a folder that is none of its run's
    return folder if folder is not None and (folder / MANIFEST).is_file() else None


def need_run(run: RunFolder | None, path: Path | str) -> RunFolder:
    """The run of a design.

    Raises:
        DataError: The design was not made by a run, or the run has gone.
    """
    if run is None:
        raise DataError(
            "the run of this design cannot be found",
            where=str(path),
            hint="give the run folder (RUN --like FILE for a rig), or put the design back into its designs folder",
        )
    return run


def relative_folder(folder: Path, path: Path) -> str:
    """How the file of a design names the folder of its run."""
    return os.path.relpath(folder.absolute(), path.parent.absolute())


def reach_of(runs: Sequence[RunFolder]) -> float | None:
    """How far any ray of the first run's design space may be heard [m]; None without a run."""
    return runs[0].config.space.high[RANGE] if runs else None


def reach_beside(files: Iterable[Path], runs: Sequence[RunFolder]) -> float | None:
    """How far rays may be heard in the first of the runs, or in that of the first design that came from one [m]."""
    if runs:
        return reach_of(runs)
    for path in files:
        # whoever reads it for good says what is wrong with it
        with contextlib.suppress(LidardesignError):
            run = run_of(load_design(path), path)
            if run is not None:
                return reach_of([run])
    return None
