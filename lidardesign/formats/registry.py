"""The export formats by name; the code of a format is imported when it is used."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from lidardesign.errors import ConfigError
from lidardesign.scenes.mujoco_models import RobotFile
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec

# Frames of a quarter of an hour and of a microsecond.
SLOWEST_HZ, FASTEST_HZ = 0.001, 1e6


@dataclass(frozen=True)
class Exporter:
    """One export format.

    Arguments:
        name: Name in `export --format`.
        suffix: Suffix of the file or folder that it writes, with the dot.
        summary: One line for `export --list`.
        module: Module of its function.
        function: Name of the function that writes it, `(design, rays, path) -> list[str]`.
        reader: Program that reads it.
        checked: How the tests check that this program reads the file.
        folder: Whether it writes a folder of files.
        rated: Whether it holds the frame rate, so that `write` takes `rate_hz` too.
        following: Whether it holds patterns that follow what they see.
        robotic: Whether it can hold a robot's model with the sensors in it, so that `write` takes `robot` too.
        steppable: Whether a frame rate of 0 means every step of a simulation.
    """

    name: str
    suffix: str
    summary: str
    module: str
    function: str
    reader: str
    checked: str
    folder: bool = False
    rated: bool = False
    robotic: bool = False
    following: bool = False
    steppable: bool = False

    def write(
        self,
        design: DesignSpec,
        rays: Rays,
        path: Path,
        rate_hz: float | None = None,
        robot: RobotFile | None = None,
    ) -> list[str]:
        """Write the file, atomically; returns notes of what the format cannot hold.

        Arguments:
            design: The design.
            rays: Its rays.
            path: The file or folder.
            rate_hz: Frames per second [Hz]; by default that of `Bandwidth`.
            robot: Robot model that receives the sensors; None: sensors alone.

        Raises:
            ConfigError: A frame rate or a robot for a format without one, or a rate out of range.
            DataError: The file cannot be written, or the format cannot hold such a design at all.
        """
        write = getattr(import_module(self.module), self.function)
        self.check_rate(rate_hz)
        if len(rays) and design.following(len(rays)) is not None and not self.following:
            raise ConfigError(
                f"{self.name} cannot hold patterns that follow what they see",
                where="--format",
                allowed=f"with {', '.join(name for name, exporter in EXPORTERS.items() if exporter.following)}",
                hint="lidardesign constrain DESIGN --adaptive 1 makes the best single pattern",
            )
        if robot is not None and not self.robotic:
            raise ConfigError(f"{self.name} cannot hold a robot", where="--robot", allowed="with mjcf")
        options: dict[str, Any] = {} if robot is None else {"robot": robot}
        if self.rated:
            options["rate_hz"] = Bandwidth().rate_hz if rate_hz is None else rate_hz
        notes = write(design, rays, Path(path), **options)
        if design.constraints:
            notes.append("the constraints of the design are lost")
        if design.mount is not None and robot is None:
            hint = "; --robot MODEL puts the sensors on it" if self.robotic else ""
            notes.append(f"places and directions are in the frame of the robot's body {design.mount!r}{hint}")
        return notes

    def check_rate(self, rate_hz: float | None) -> None:
        """Refuse a frame rate [Hz] that is out of range, or that the format cannot hold.

        Raises:
            ConfigError: Such a rate.
        """
        if rate_hz is not None and not SLOWEST_HZ <= rate_hz <= FASTEST_HZ and not (self.steppable and rate_hz == 0):
            every = ", or 0: at every step" if self.steppable else ""
            raise ConfigError(f"{rate_hz}", where="--rate-hz", allowed=f"{SLOWEST_HZ:g} to {FASTEST_HZ:g} Hz{every}")
        if rate_hz is not None and not self.rated:
            rated = ", ".join(name for name, exporter in EXPORTERS.items() if exporter.rated)
            raise ConfigError(
                f"{self.name} cannot hold a frame rate", where="--rate-hz", allowed=f"with {rated}" if rated else "none"
            )


EXPORTERS: dict[str, Exporter] = {
    exporter.name: exporter
    for exporter in (
        Exporter(
            "csv",
            ".csv",
            "one ray per row: origin, direction, angles, gate, time",
            "lidardesign.formats.ray_lists",
            "write_csv",
            reader="anything that reads CSV; `evaluate` and `fit` too",
            checked="read by numpy",
            following=True,
        ),
        Exporter(
            "npz",
            ".npz",
            "the same columns as numpy arrays",
            "lidardesign.formats.ray_lists",
            "write_npz",
            reader="numpy",
            checked="read by numpy",
            following=True,
        ),
        Exporter(
            "sensors-csv",
            ".sensors.csv",
            "one sensor per row, the 16 columns of the research code",
            "lidardesign.formats.ray_lists",
            "write_sensor_csv",
            reader="the research code of the paper",
            checked="read as a design; the columns are those of its own files",
        ),
        Exporter(
            "galvo",
            ".galvo.csv",
            "mirror angles in the order of least travel, gates in ps: +-20 degrees per axis",
            "lidardesign.formats.galvo",
            "write_galvo",
            reader="a script that drives two mirrors and a gated detector",
            checked="read by `capture`",
        ),
        Exporter(
            "mjcf",
            ".mjcf.xml",
            "a rangefinder site per ray",
            "lidardesign.formats.robots",
            "write_mjcf",
            robotic=True,
            rated=True,
            steppable=True,
            reader="MuJoCo",
            checked="loaded and run in MuJoCo: its distances agree with ours",
        ),
        Exporter(
            "sdf",
            ".sdf",
            "a gpu_lidar per sensor, on even grids",
            "lidardesign.formats.robots",
            "write_sdf",
            reader="Gazebo",
            checked="parsed by libsdformat without a warning, all values compared; its pixels in a twin",
            rated=True,
        ),
        Exporter(
            "urdf",
            ".urdf",
            "a fixed link per sensor, with Gazebo's gpu_lidar",
            "lidardesign.formats.robots",
            "write_urdf",
            reader="ROS, robot_state_publisher",
            checked="parsed by check_urdf; sensors by libsdformat",
            rated=True,
        ),
        Exporter(
            "xacro",
            ".urdf.xacro",
            "the same as a macro that mounts it on a robot",
            "lidardesign.formats.robots",
            "write_xacro",
            reader="ROS, xacro",
            checked="expanded by xacro and parsed by check_urdf",
            rated=True,
        ),
        Exporter(
            "carla",
            ".carla.json",
            "attributes and transform of a ray_cast lidar per sensor",
            "lidardesign.formats.simulators",
            "write_carla",
            reader="a script that sets blueprint attributes",
            checked="names and types against CARLA's documented ones; its sweep in a twin",
            rated=True,
        ),
        Exporter(
            "isaac-usd",
            ".usda",
            "an OmniLidar per sensor, gates per ray",
            "lidardesign.formats.simulators",
            "write_isaac_usd",
            reader="Isaac Sim from 5 on",
            checked="opened with OpenUSD; types, tokens and lengths as its schema has them",
            rated=True,
        ),
        Exporter(
            "helios",
            ".helios",
            "a scanner per sensor with a channel per ray, and surveys of one frame each",
            "lidardesign.formats.ray_tracers",
            "write_helios",
            reader="HELIOS++",
            checked="valid by schemas of its fields; a twin of HELIOS++ fires the rays and finds their echoes",
            folder=True,
            rated=True,
        ),
        Exporter(
            "osi",
            ".osi.json",
            "a lidar configuration per sensor: mounting position, unit vectors, microseconds",
            "lidardesign.formats.simulators",
            "write_osi",
            reader="sensor models and simulators of ASAM OSI",
            checked="parsed by protobuf, with ASAM's own bindings where they are",
            rated=True,
        ),
        Exporter(
            "rgl",
            ".rgl",
            "a pattern of float32 ray poses per sensor, and the model with the plugin",
            "lidardesign.formats.ray_tracers",
            "write_rgl",
            reader="Robotec GPU Lidar and its Gazebo plugin",
            checked="parsed by libsdformat; a twin reads patterns as the plugin does",
            folder=True,
            rated=True,
        ),
        Exporter(
            "mitsuba",
            ".mitsuba",
            "a scene per sensor: gated film, rays as radiancemeters, a flash beside them",
            "lidardesign.formats.ray_tracers",
            "write_mitsuba",
            reader="Mitsuba 3 with mitransient",
            checked="rendered by them: light comes back in the bin of its range",
            folder=True,
        ),
        Exporter(
            "mounts",
            ".mounts",
            "a page to mount from, the same as CSV, and ROS frames",
            "lidardesign.formats.mount_page",
            "write_mounts",
            reader="people who build it; ROS",
            checked="a design is built from the CSV in MuJoCo: all ranges agree",
            folder=True,
        ),
        Exporter(
            "ply",
            ".ply.d",
            "rays as points, beams as edges, fields of view as surfaces",
            "lidardesign.formats.meshes",
            "write_ply",
            reader="CloudCompare, Blender, MeshLab",
            checked="loaded by trimesh; names as CloudCompare and Blender know them",
            folder=True,
        ),
        Exporter(
            "stl",
            ".stl",
            "mounting positions as small solids, in millimetres",
            "lidardesign.formats.meshes",
            "write_stl",
            reader="CAD programs",
            checked="loaded by trimesh as closed solids",
        ),
    )
}
