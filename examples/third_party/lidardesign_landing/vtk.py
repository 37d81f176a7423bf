"""The format `vtk`: every ray as a line from its origin through its gate, in metres, for ParaView."""

import numpy as np
from lidardesign import DataError, Format, Rig, RigSensor

HEAD = "# vtk DataFile Version 3.0\nrays: origin, start and end of the gate [m]\nASCII\nDATASET POLYDATA\nPOINTS "


def rows(table):
    return "".join(" ".join(map(repr, row)) + "\n" for row in table.tolist())


def write(design, rays, path, options):
    """Write three points and a line per ray; returns what the file does not hold."""
    gate = [rays.origin_m + end[:, None] * rays.direction for end in rays.gate_m.T]
    points = np.stack([rays.origin_m, *gate], axis=1).reshape(-1, 3)
    lines = np.insert(np.arange(len(points)).reshape(-1, 3), 0, 3, axis=1)
    path.write_text(f"{HEAD}{len(points)} double\n{rows(points)}LINES {len(lines)} {lines.size}\n{rows(lines)}")
    return ["sensors and firing times are lost"]


def read(path):
    """The rays of such a file, all of one sensor."""
    text = path.read_text()
    if not text.startswith(HEAD):
        raise DataError("is not a VTK file of rays", where=str(path))
    points = np.loadtxt(text.partition("LINES")[0].splitlines()[5:]).reshape(-1, 3, 3)
    x, y, z = (points[:, 2] - points[:, 0]).T
    gate = np.linalg.norm(points[:, 1:] - points[:, :1], axis=2)
    return Rig("VTK file", [RigSensor("all", points[:, 0], np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), gate)])


VTK = Format("vtk", ".vtk", "a line per ray along its gate", write, reader="ParaView", checked="by VTK 9.7", read=read)
