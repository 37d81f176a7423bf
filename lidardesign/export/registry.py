"""The export formats by name; the code of a format is imported when it is used."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from lidardesign.design.sensor import Design
from lidardesign.errors import ConfigError
from lidardesign.estimates import Estimate
from lidardesign.simulate.returns import Rays


@dataclass(frozen=True)
class Exporter:
    """One export format.

    Arguments:
        name: As `export --format` takes it.
        suffix: Of the file that it writes, with the dot.
        summary: One line for `export --list`.
        module: Where its `write(design, rays, path) -> list[str]` is, and `rounding(design, rays, path)`, which reads
            the file back and says what its numbers lose.
    """

    name: str
    suffix: str
    summary: str
    module: str

    def write(self, design: Design, rays: Rays, path: Path) -> list[str]:
        """Write the file, atomically; returns notes of what the format cannot hold.

        Raises:
            DataError: The file cannot be written.
        """
        return import_module(self.module).write(design, rays, Path(path))

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
            "csv", ".csv", "one ray per row: origin, direction, angles, gate, time", "lidardesign.export.csv"
        ),
        Exporter("npz", ".npz", "the same columns as numpy arrays", "lidardesign.export.npz"),
        Exporter(
            "sensors-csv",
            ".sensors.csv",
            "one sensor per row, the 16 columns of the research code",
            "lidardesign.export.sensors_csv",
        ),
        Exporter(
            "galvo",
            ".galvo.csv",
            "mirror angles in the order of least travel, gates in ps: +-20 degrees per axis",
            "lidardesign.export.galvo",
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
