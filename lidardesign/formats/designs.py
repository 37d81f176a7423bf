"""Designs from files: design files, the research code's tables, and rigs of other programs, recognised by content.

Files whose content does not match their suffix are refused before YAML is tried.
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
from lidardesign.formats import FORMATS
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
from lidardesign.plugins import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.run.inputs import DESIGN, RAY_TABLE, read_head
from lidardesign.run.manifest import changed_since_recorded
from lidardesign.run.xml import read_xml
from lidardesign.run.yaml import KeyPath, load_yaml
from lidardesign.run_folder import DESIGN_FOLDER, MANIFEST, Notes, RunFolder, log_note
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_from_document, digested
from lidardesign.space import RANGE

CSV, NPZ, XML = "CSV", "NPZ", "XML"
KINDS = {".csv": CSV, ".npz": NPZ, ".xml": XML, ".mjcf": XML, ".sdf": XML, ".world": XML}
# Suffixes of files that are read here, so that no format of another package is asked.
KNOWN = {"", ".yaml", ".yml", ".json", *KINDS}
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
# ZIP archives with and without members.
ZIP_BEGINNINGS = (b"PK\x03\x04", b"PK\x05\x06")
# "<" in UTF-8, and in UTF-16 with its byte order mark.
XML_BEGINNINGS = (b"<", b"\xff\xfe<\x00", b"\xfe\xff\x00<")
UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# A mapping of YAML begins with a key, a document mark or a brace.
YAML_LINE = re.compile(r"(---|[{%\[]|- |['\"]?[A-Za-z_][\w ]*['\"]?\s*:(\s|$))")
SEPARATORS = {";": "; (a semicolon)", "\t": "tabs", "|": "| (a vertical bar)"}
HEADER_HINT = "name the columns: origin_x_m,origin_y_m,origin_z_m,azimuth_deg,elevation_deg,gate_start_m,gate_end_m"


@phase("designs")
def load_design(path: Path, reach_m: float | None = None) -> DesignSpec:
    """Read a design from a design file, the research code's sensor CSV or a rig of another program.

    The design takes the file's stem as its name, as tables name designs by their files.

    Arguments:
        path: The file.
        reach_m: End of a rig's gates without one in its file [m].

    Raises:
        DataError: The file cannot be read, or is a CSV, NPZ or XML file with invalid content (exit 3).
        ConfigError: The file is not YAML, or not a design (exit 2).
    """
    head = read_head(path, RAY_TABLE, hint="give a design file, such as RUN/designs/NAME.yaml")
    name = path.suffix.removeprefix(".")
    if path.suffix.lower() not in KNOWN and name in FORMATS.names() and not FORMATS.is_shipped(name):
        foreign, facts = FORMATS.loaded(name)
        if facts["reads"]:
            with plugin_guard(name, "format"):
                return rig_design(foreign.read(path), path, reach_m)
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
    """The rig in a file; None for a design file or the research code's sensor table.

    Arguments:
        path: The file.
        head: Its first bytes.

    Raises:
        DataError: It is an invalid file of a rig.
    """
    if head.startswith(ZIP_BEGINNINGS):
        return read_ray_npz(path)
    _check_bytes(path, head)
    if head.removeprefix(codecs.BOM_UTF8).lstrip().startswith(XML_BEGINNINGS):
        tag = read_xml(path, ALLOWED[XML]).tag
        if tag not in XML_ROOTS:
            raise DataError(
                f"its root element is {f'<{tag[:40]}>'!r}",
                where=str(path),
                allowed=ALLOWED[XML],
                hint=OTHER_ROOTS.get(tag),
            )
        return XML_ROOTS[tag](path)
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    texts = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    if not begins_as_sensor_csv(head):
        _check_text(path, texts)
        return None
    _, first = texts[0]
    # the commas may be decimal commas between columns with another separator
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
    """Refuse a file with a known suffix that is empty, or is not text where it should be; ZIP archives pass."""
    kind = KINDS.get(path.suffix.lower())
    if kind is None or head.startswith(b"PK"):
        return
    if not head.strip():
        raise DataError("is empty", where=str(path), allowed=ALLOWED[kind])
    try:
        # a letter may be cut at the end
        codecs.getincrementaldecoder("utf-8")().decode(head)
        is_text = b"\0" not in head
    except UnicodeDecodeError:
        is_text = kind == XML and head.startswith(UTF16_MARKS)
    if not is_text:
        found = {CSV: "is not UTF-8 text", NPZ: "is not an NPZ archive", XML: "is not XML"}[kind]
        raise DataError(
            f"{found}, or is damaged",
            where=str(path),
            allowed=ALLOWED[kind],
            hint="save it as UTF-8" if kind == CSV else None,
        )


def _check_text(path: Path, texts: list[tuple[int, str]]) -> None:
    """Refuse a text with a known suffix, as numbered lines, that neither its reader nor YAML accepts."""
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
    return DataError(
        f"columns are separated by {SEPARATORS[separator]}",
        where=where,
        allowed=ALLOWED[CSV],
        hint="save it with commas, and with points in numbers",
    )


def read_design(path: Path, notes: Notes = log_note, reach_m: float | None = None) -> DesignSpec:
    """Read a design file or a rig of another program, with notes.

    Notes say if a run's design differs from the one that was written, truncated or edited by hand, which certificates
    are of other rays and so left out, and which values the file of a rig is missing.

    Arguments:
        path: The file.
        notes: Called with every note.
        reach_m: End of a rig's gates without one in its file [m].

    Raises:
        ConfigError, DataError: It cannot be read.
    """
    difference = _difference(path)
    try:
        design = load_design(path, reach_m)
    except (ConfigError, DataError) as error:
        if difference is None:
            raise
        raise type(error)(
            error.message,
            where=error.where,
            allowed=error.allowed,
            hint=f"the file {difference}; fit it again, or correct it",
        ) from None
    if difference is not None:
        notes(f"{path} {difference}")
    kept = tuple(one for one in design.certificates if digested(one, design) == one)
    if len(kept) < len(design.certificates):
        of = ", ".join(f"{one.get('rays')!r:.20}" for one in design.certificates if one not in kept)
        notes(f"{path}: the certificate for {of} rays is of other rays or was changed: left out; fit again for another")
    # only what was read from others has notes
    further = design.provenance.get("notes") if "source" in design.provenance else None
    for note in further if isinstance(further, list) else ():
        notes(f"{path}: {note}")
    return replace(design, certificates=kept)


def _difference(path: Path) -> str | None:
    """Difference of a run's design from the one in the run's manifest, or None."""
    folder, run = path.absolute().parent, path.absolute().parent.parent
    if folder.name == DESIGN_FOLDER and path.is_file() and (run / MANIFEST).is_file():
        with contextlib.suppress(DataError):  # a damaged manifest is reported where it is needed
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
    """The run that a design came from, or None if it is missing."""
    folder = folder_of(design, path)
    return None if folder is None else RunFolder.open(folder)


def folder_of(design: DesignSpec, path: Path) -> Path | None:
    """Folder of the run in a design's provenance, relative to its file, or None if it is missing."""
    named = design.provenance.get("run")
    folder = Path(os.path.normpath(path.parent / named)) if isinstance(named, str) else None
    # the path in a design that was copied elsewhere leads to no run
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
    """Path of a run's folder relative to the file of a design."""
    return os.path.relpath(folder.absolute(), path.parent.absolute())


def reach_of(runs: Sequence[RunFolder]) -> float | None:
    """Largest range of the first run's design space [m]; None without a run."""
    return runs[0].config.space.high[RANGE] if runs else None


def reach_beside(files: Iterable[Path], runs: Sequence[RunFolder]) -> float | None:
    """Largest range of the first run's design space, or of the first design's run [m]; None without any."""
    if runs:
        return reach_of(runs)
    for path in files:
        # errors are reported when the design itself is read
        with contextlib.suppress(LidardesignError):
            run = run_of(load_design(path), path)
            if run is not None:
                return reach_of([run])
    return None
