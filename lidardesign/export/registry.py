"""The export formats by name; the code of a format is imported when it is used."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import Design
from lidardesign.errors import ConfigError
from lidardesign.estimates import Estimate
from lidardesign.simulate.returns import Rays


@dataclass(frozen=True)
class Exporter:
    """One export format.

    Arguments:
        name: As `export --format` takes it.
        suffix: Of the file that it writes, with the dot; of the folder where it writes several.
        summary: One line for `export --list`.
        module: Where its `write(design, rays, path) -> list[str]` is, and `rounding(design, rays, path)`, which reads
            the file back and says what its numbers lose.
        reader: The program that reads it.
        checked: How the tests show that this program takes what is written.
        folder: Whether it writes a folder of files.
        rated: Whether it holds the frame rate, so that `write` takes `rate_hz` too.
    """

    name: str
    suffix: str
    summary: str
    module: str
    reader: str
    checked: str
    folder: bool = False
    rated: bool = False

    def write(self, design: Design, rays: Rays, path: Path, rate_hz: float | None = None) -> list[str]:
        """Write the file, atomically; returns notes of what the format cannot hold.

        Arguments:
            design: The design.
            rays: Its rays.
            path: The file or folder.
            rate_hz: Frames per second [Hz]; that of the read-out model by default.

        Raises:
            ConfigError: A frame rate for a format that holds none.
            DataError: The file cannot be written, or the format cannot hold such a design at all.
        """
        write = import_module(self.module).write
        if self.rated:
            return write(design, rays, Path(path), rate_hz=Bandwidth().rate_hz if rate_hz is None else rate_hz)
        if rate_hz is not None:
            rated = ", ".join(name for name, exporter in EXPORTERS.items() if exporter.rated)
            raise ConfigError(
                f"{self.name} holds no frame rate", where="--rate-hz", allowed=f"with {rated}" if rated else "none"
            )
        return write(design, rays, Path(path))

    def rounding(self, design: Design, rays: Rays, path: Path) -> dict[str, Estimate]:
        """What the numbers in a file that was just written lose, by reading it back: the largest error of each kind.

        Raises:
            DataError: The file does not hold what was written.
        """
        return import_module(self.module).rounding(design, rays, Path(path))


EXPORTERS: dict[str, Exporter] = {
    exporter.name: exporter
    for exporter in (
        Exporter(
            "csv",
            ".csv",
            "one ray per row: origin, direction, angles, gate, time",
            "lidardesign.export.csv",
            reader="anything that reads CSV; `evaluate` and `fit` too",
            checked="read by numpy, and read back",
        ),
        Exporter(
            "npz",
            ".npz",
            "the same columns as numpy arrays",
            "lidardesign.export.npz",
            reader="numpy",
            checked="read by numpy, and read back",
        ),
        Exporter(
            "sensors-csv",
            ".sensors.csv",
            "one sensor per row, the 16 columns of the research code",
            "lidardesign.export.sensors_csv",
            reader="the research code of the paper",
            checked="read back; the columns are those of its own files",
        ),
        Exporter(
            "galvo",
            ".galvo.csv",
            "mirror angles in the order of least travel, gates in ps: +-20 degrees per axis",
            "lidardesign.export.galvo",
            reader="a script that drives two mirrors and a gated detector",
            checked="read back, and by `capture`",
        ),
    )
}


def find_exporter(name: str) -> Exporter:
    """The exporter of a format.

    Raises:
        ConfigError: There is no such format.
    """
    if name not in EXPORTERS:
        raise ConfigError(f"no format is called {name!r}", where="--format", allowed=", ".join(EXPORTERS))
    return EXPORTERS[name]
