"""Laws of the contract of export formats, tried on eight small designs: files are repeatable, whole and honest.

The designs, in the folder `designs`, have one ray, gates per ray, spread origins, rings, a real part, a robot's body, a
condition and patterns that follow what they see.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.contract.law import BrokenLawError, Law, LawHolds, NotApplicable, Tried
from lidardesign.errors import ConfigError, DataError
from lidardesign.formats import ADAPTIVE, EVERY_STEP, RATE, RAYS, ROBOT, Format, WriteOptions, folder_contents
from lidardesign.formats.designs import load_design
from lidardesign.formats.rig import rig_design
from lidardesign.numerics import COARSE_SLACK
from lidardesign.run.content import fingerprint
from lidardesign.run.files import remove
from lidardesign.scenes.mujoco_models import RobotFile
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec

DESIGNS = Path(__file__).parent / "designs"
# Of a condition, between the knots of its pattern.
AT = 0.5
OTHER_RATE_HZ, REACH_M = 20.0, 9.0
HAND = '<mujoco><worldbody><body name="hand"><geom size="0.1"/></body></worldbody></mujoco>'
# The notes of a file, and its content, or that of all files of a folder by their names.
Written = tuple[list[str], dict[str, bytes]]


class FormatSubject(Tried):
    """A format, tried by the laws.

    Arguments:
        format: The plugin.
        conduct: The limit and what else `Tried` takes.
    """

    def __init__(self, format: Format, *conduct: Any) -> None:
        super().__init__("format", format.name, *conduct)
        self.format, most = format, None if RAYS in format.holds else 0
        found = [load_design(path) for path in sorted(DESIGNS.glob("*.yaml"))]
        here = [one.at_condition({one.condition: AT}) if one.condition else one for one in found]
        self.designs = {one.name: (one, one.rays().subset(slice(most))) for one in here}

    @contextmanager
    def place(self) -> Iterator[Path]:
        """A context with the path of a file that is not there, alone in its folder."""
        with tempfile.TemporaryDirectory(prefix="lidardesign-") as folder:
            yield Path(folder) / f"design{self.format.suffix}"

    def write(self, path: Path, design: DesignSpec, rays: Rays, **options: Any) -> Written | None:
        """Have a design written anew; None where the format refuses it."""
        remove(path)
        notes = None
        with self.calling("write"), suppress(ConfigError, DataError):
            notes = self.format.write(design, rays, path, WriteOptions(**options))
        files = folder_contents(path.parent)
        if notes is None and not files:
            return None
        if not (isinstance(notes, list) and (path.is_dir() if self.format.is_folder else [*files] == [path.name])):
            raise BrokenLawError(
                f"{design.name}: wrote {', '.join(files) or 'nothing'}, and returned {notes!r:.80}",
                allowed=f"{path.name} alone, and a list of notes",
            )
        return notes, files


def check_written(subject: FormatSubject) -> LawHolds:
    """Each design is written or refused, some are written, and the second time there are the same bytes."""
    refused = []
    with subject.place() as path:
        for name, case in subject.designs.items():
            before = fingerprint(case)
            first, again = (subject.write(path, *case) for _ in range(2))
            if first != again or fingerprint(case) != before:
                wrong = "other bytes or notes the second time" if first != again else "writing changed the design"
                raise BrokenLawError(f"{name}: {wrong}", hint="work on copies, without times, random numbers and sets")
            refused += [name] * (first is None)
    if len(refused) == len(subject.designs):
        raise BrokenLawError("refuses every design")
    said = f"{len(subject.designs) - len(refused)} of {len(subject.designs)} designs, twice the same"
    return LawHolds(f"{said}; refused: {', '.join(refused) or 'none'}", {"refused": len(refused)})


def check_held(subject: FormatSubject) -> LawHolds:
    """What a format holds changes the file."""
    (design, rays), (adaptive, _) = (subject.designs[name] for name in ("mounted", "adaptive"))
    with subject.place() as path, tempfile.TemporaryDirectory(prefix="lidardesign-") as folder:
        robot = Path(folder) / "robot.xml"
        robot.write_text(HAND, encoding="utf-8")
        changes: dict[str, tuple[DesignSpec, Rays, dict[str, Any]]] = {
            RAYS: (design, rays.subset(slice(1)), {}),
            RATE: (design, rays, {"rate_hz": OTHER_RATE_HZ}),
            EVERY_STEP: (design, rays, {"rate_hz": 0.0}),
            ROBOT: (design, rays, {"robot": RobotFile(robot)}),
            ADAPTIVE: (replace(design, adaptive=adaptive.adaptive), rays, {}),
        }
        without = subject.write(path, design, rays)
        for what in sorted(subject.format.holds):
            changed, fired, options = changes[what]
            found = subject.write(path, changed, fired, **options)
            if not found or (without and without[1] == found[1]):
                raise BrokenLawError(
                    f"says that it holds {what}, but {'writes the same without' if found else 'refuses it'}",
                    hint=f"leave {what} out of holds",
                )
    return LawHolds(f"holds {', '.join(sorted(subject.format.holds)) or 'sensors alone'}")


def check_whole(subject: FormatSubject) -> LawHolds:
    """Where writing fails, what was there stays as it was, and nothing half-written is left."""
    design, rays = subject.designs["mounted"]
    with subject.place() as path:
        taken = path if subject.format.is_folder else path / "mine"
        taken.parent.mkdir(exist_ok=True)
        taken.write_bytes(b"mine")
        for fired in (rays, replace(rays, sensor=rays.sensor + len(rays))):
            before, failed = folder_contents(path.parent), True
            with subject.calling("write"), suppress(Exception):
                subject.format.write(design, fired, path, WriteOptions())
                failed = False
            if (before or failed) and folder_contents(path.parent) != before:
                raise BrokenLawError(
                    "writes over what is in its place" if before else "leaves a half-written file where it fails",
                    hint="write what is whole: lidardesign.run.files.write_atomic",
                )
            remove(path)
    return LawHolds("what is in its place stays, and nothing half-written is left")


def check_read(subject: FormatSubject) -> LawHolds | NotApplicable:
    """Rays that are written and read again are the same to the file's digits, or notes say what is lost."""
    read = getattr(subject.format, "read", None)
    if read is None:
        return NotApplicable("the format has no read")
    with subject.place() as path:
        for name, (design, rays) in subject.designs.items():
            written = None if design.adaptive else subject.write(path, design, rays)
            if written is None:
                continue
            with subject.calling("read"):
                found = rig_design(read(path), path, REACH_M).rays()
            if len(found) != len(rays):
                raise BrokenLawError(f"{name}: {len(found)} rays were read of {len(rays)}")
            pairs = {key: (getattr(found, key), getattr(rays, key)) for key in ("origin_m", "direction", "gate_m")}
            lost = [key for key, pair in pairs.items() if not np.allclose(*pair, atol=COARSE_SLACK)]
            if len(lost) > len(written[0]):
                raise BrokenLawError(f"{name}: {', '.join(lost)} came back changed, and {len(written[0])} notes say so")
    return LawHolds("rays come back, or notes say what is lost")


_AFTER_FIRST = ("designs are written",)
LAWS = (
    Law("designs are written", "files", "eight designs are written or refused, twice the same", check_written),
    Law("says what it holds", "files", "what it holds changes the file", check_held, needs=_AFTER_FIRST),
    Law("files are whole", "files", "nothing is half-written, or over another's", check_whole, needs=_AFTER_FIRST),
    Law("rays come back", "files", "what read finds was written, or notes say", check_read, needs=_AFTER_FIRST),
)
