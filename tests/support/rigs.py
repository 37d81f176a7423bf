"""Designs that exports are tried on, and libsdformat as a program."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from lidardesign.scenes.rays import Rays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import Pattern
from lidardesign.space import angles, direction
from support.sensors import normal_sensor

NASTY = 'b</script> "&amp;" \\ ö\'{x}${y}'


def sensor(name, origin_m, azimuth_rad, elevation_rad, roll_rad):
    return normal_sensor(name, 0.25, origin_m, azimuth_rad, elevation_rad, roll_rad, (0.2, 0.1), 1.5, 0.3)


def rig():
    """Four sensors: even grids, one of them ahead of its own frame's middle, a loose bundle, one ray straight down."""
    sensors = (
        sensor("front left", (0.4, -0.2, 1.1), 2.5, -0.4, 0.3),
        sensor(NASTY, (0.0, 0.3, 0.8), -1.0, 0.5, 0.0),
        sensor("down", (0.1, 0.1, 2.0), 0.7, -np.pi / 2, -0.2),
        sensor("front_left", (-0.3, 0.5, 0.2), 5.9, 0.1, 0.0),
    )
    generator = np.random.default_rng(3)
    local = [
        even(5, 4, (-0.3, 0.3), (-0.2, 0.15)),
        direction(generator.uniform(-0.5, 0.5, 23), generator.uniform(-0.4, 0.2, 23)),
        direction(np.zeros(1), np.zeros(1)),
        even(3, 2, (0.1, 0.4), (0.05, 0.3)),
    ]
    owner = np.repeat(np.arange(4), [len(one) for one in local])
    looking = np.concatenate([one @ sensors[index].frame for index, one in enumerate(local)])
    origin = np.array([one.origin_m for one in sensors])[owner]
    loose = owner == 1
    origin[loose] += generator.uniform(-0.05, 0.05, (23, 3))
    gate = np.array([(0.2, 3.0), (0.5, 2.0), (0.0, 1.0), (1.0, 4.0)])[owner]
    gate[loose] += generator.uniform(0, 0.2, (23, 2))
    rays = Rays(origin, looking, gate, owner, np.arange(len(owner)) / (10.0 * len(owner)))
    # rays of different sensors take turns
    shuffled = generator.permutation(len(owner))
    rays = rays.subset(shuffled)
    return DesignSpec("a rig", sensors, "fixed", (Pattern.of(rays),)), rays


def even(columns, rows, azimuth_rad, elevation_rad):
    """Unit vectors of an even grid."""
    azimuth, elevation = np.meshgrid(np.linspace(*azimuth_rad, columns), np.linspace(*elevation_rad, rows))
    return direction(azimuth.ravel(), elevation.ravel())


def spinning(columns=36, rows=4):
    """One sensor that turns all round."""
    step = 2 * np.pi / columns
    local = even(columns, rows, (-np.pi, np.pi - step), (-0.25, 0.3))
    one = sensor("spin", (0.0, 0.0, 1.0), 0.4, 0.0, 0.0)
    count = len(local)
    rays = Rays(
        np.tile(one.origin_m, (count, 1)), local @ one.frame, np.tile((0.5, 9.0), (count, 1)), np.zeros(count),
        np.arange(count) / (10.0 * count),
    )  # fmt: skip
    return DesignSpec("spinner", (one,), "fixed", (Pattern.of(rays),)), rays


def farthest_nearest(wanted, fired):
    """The largest angle from a wanted unit vector to the nearest of those that are fired, by brute force."""
    cosine = np.clip(wanted @ fired.T, -1, 1).max(axis=1)
    nearest = fired[np.argmax(wanted @ fired.T, axis=1)]
    return float(np.max(np.where(cosine > 0.999, np.linalg.norm(wanted - nearest, axis=1), np.arccos(cosine))))


def tilted(design, rays):
    """A sensor's rays by azimuth and elevation in its own frame, sensor by sensor."""
    return [angles(rays.direction[rays.sensor == i] @ one.frame.T) for i, one in enumerate(design.sensors)]


def sdf_reader(folder: Path) -> Path:
    """The program that prints what libsdformat makes of a file, compiled; a skip where it cannot be."""
    if shutil.which("g++") is None or shutil.which("pkg-config") is None:
        pytest.skip("needs g++ and pkg-config: tools/install-consumers.sh")
    flags = subprocess.run(["pkg-config", "--cflags", "--libs", "sdformat12"], capture_output=True, text=True)
    if flags.returncode:
        pytest.skip("needs libsdformat 12: tools/install-consumers.sh")
    program, source = folder / "sdf_reader", Path(__file__).with_name("sdf_reader.cpp")
    subprocess.run(["g++", "-std=c++17", "-O0", source, "-o", program, *flags.stdout.split()], check=True)
    return program


def read_sdf(program: Path, path: Path) -> list[dict]:
    """What libsdformat finds: a dictionary per sensor; it must say nothing of faults."""
    done = subprocess.run([program, path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not done.stderr, done.stderr
    sensors = []
    for line in done.stdout.splitlines():
        name, kind, topic, *numbers = line.split()
        keys = ("x", "y", "z", "qw", "qx", "qy", "qz", "rate", "columns", "left", "right", "rows", "low", "high",
                "horizontal_resolution", "vertical_resolution", "start", "end")  # fmt: skip
        # of sensors that are none of its own it knows the pose only
        values = dict(zip(keys, map(float, numbers), strict=kind != "custom"))
        sensors.append({"name": name, "kind": kind, "topic": topic, **values})
    return sensors
