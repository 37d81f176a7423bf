"""Scanner, platform and survey files for HELIOS++: one scanner per sensor, one channel per ray, one pulse of each.

HELIOS++ fires along the y axis of a scanner and turns it by the channel's rotations about fixed axes: about x by the
elevation, then about z by the azimuth less a quarter turn. Channels start at their own offset from the platform and
have their own range limits, so any list of rays with any gates is held. A leg ends when the head has turned far enough:
it turns by one degree in front of the only pulse, from -1 to 0, and the leg ends there.
"""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import child, document, element, read_xml, write_folder
from lidardesign.export.common.poses import (
    Mount,
    Part,
    design_losses,
    mounts,
    rays_of_parts,
    rays_rounding,
    require_rays,
)
from lidardesign.geometry.rays import Rays
from lidardesign.scene import SPEED_OF_LIGHT_M_S
from lidardesign.space import angles, direction

SCANNERS, PLATFORMS, SURVEY, SCENE = "scanners.xml", "platforms.xml", ".survey.xml", "scene.xml#scene"
# HELIOS++ drops echoes whose rise begins before the gate does: a short pulse, in fine bins, loses little.
PULSE_NS, BIN_NS = 0.1, 0.01
# Peaks are told apart over a quarter of a pulse.
WINDOW_NS = PULSE_NS / 4
NS_PER_S = 1e9
MM_PER_M = 1000


def write_helios(design: DesignSpec, rays: Rays, path: Path, rate_hz: float) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the folder cannot be written.
    """
    require_rays(design, rays, "a HELIOS++ scanner")
    pulse_hz = max(round(rate_hz), 1)
    mounted = mounts(design, rays)
    scanners = element("document")
    surveys = {}
    for mount in mounted:
        _add_scanner(scanners, mount, rays.subset(mount.ray), pulse_hz)
        # One leg of one pulse, at the place where the sensor's first ray starts
        root = element("document")
        survey = child(
            root, "survey", name=f"{design.name}: {mount.sensor.name}", scene=SCENE,
            platform=f"{PLATFORMS}#fixed", scanner=f"{SCANNERS}#{mount.name}",
        )  # fmt: skip
        child(survey, "FWFSettings", beamSampleQuality=1, binSize_ns=BIN_NS, winSize_ns=WINDOW_NS)
        leg = child(survey, "leg")
        x, y, z = rays.origin_m[mount.ray[0]].tolist()
        child(leg, "platformSettings", x=x, y=y, z=z, onGround=False)
        child(
            leg, "scannerSettings", active=True, pulseFreq_hz=pulse_hz, scanAngle_deg=1, scanFreq_hz=0,
            verticalAngleMin_deg=-1, verticalAngleMax_deg=1, headRotatePerSec_deg=pulse_hz,
            headRotateStart_deg=-1, headRotateStop_deg=-0.5,
        )  # fmt: skip
        surveys[f"{mount.name}{SURVEY}"] = document(root)
    # a platform that stands still, its scanner at its own place
    platforms = element("document")
    child(child(platforms, "platform", id="fixed", name="fixed", type="static"), "scannerMount", x=0, y=0, z=0)
    lost_m = PULSE_NS / NS_PER_S * SPEED_OF_LIGHT_M_S
    notes = [
        *write_folder(path, {SCANNERS: document(scanners), PLATFORMS: document(platforms), **surveys}),
        f"the surveys name the scene {SCENE}: put yours beside them, and give the folder to helios as --assets",
        f"HELIOS++ drops returns up to {MM_PER_M * lost_m:.0f} mm behind a gate's start: the rise of a {PULSE_NS} ns "
        "pulse must begin inside",
        "all rays of a frame fire at once: their times within the frame are not held",
    ]
    if pulse_hz != rate_hz:
        notes.append(f"{rate_hz:g} frames per second became {pulse_hz}: HELIOS++ knows whole numbers only")
    return [*notes, *design_losses(design, mounted)]


def _add_scanner(root: Element, mount: Mount, rays: Rays, pulse_hz: int) -> None:
    """One sensor, its rays as channels; their places are offsets from the first one's."""
    scanner = child(
        root, "scanner", id=mount.name, name=mount.sensor.name, optics="rotating",
        pulseFreqs_Hz=pulse_hz, pulseLength_ns=PULSE_NS, scanAngleMax_deg=1, scanAngleEffectiveMax_deg=1,
        scanFreqMin_Hz=0, scanFreqMax_Hz=0, maxNOR=1, headRotatePerSecMax_deg=pulse_hz,
    )  # fmt: skip
    child(scanner, "FWFSettings", beamSampleQuality=1, binSize_ns=BIN_NS, winSize_ns=WINDOW_NS)
    child(scanner, "headRotateAxis", x=0, y=0, z=1)
    channels = child(scanner, "channels")
    azimuth_deg, elevation_deg = (np.degrees(values) for values in angles(rays.direction))
    for number, (x, y, z) in enumerate((rays.origin_m - rays.origin_m[0]).tolist()):
        start, end = rays.gate_m[number].tolist()
        origin = child(
            child(channels, "channel", id=number, rangeMin_m=start, rangeMax_m=end), "beamOrigin", x=x, y=y, z=z
        )
        child(origin, "rot", axis="x", angle_deg=float(elevation_deg[number]))
        child(origin, "rot", axis="z", angle_deg=float(azimuth_deg[number] - 90.0))


def read_helios(path: Path, design: DesignSpec, rays: Rays) -> Rays:
    """The rays of a folder that `write_helios` made of a design and its rays, with their sensors and times.

    Raises:
        DataError: The folder cannot be read, or holds something else.
    """
    path = Path(path)
    scanners = {scanner.get("id"): scanner for scanner in read_xml(path / SCANNERS, "document")}
    parts = [
        _part(mount.ray, scanners.get(mount.name), path / f"{mount.name}{SURVEY}") for mount in mounts(design, rays)
    ]
    return rays_of_parts(rays, parts, str(path))


def _part(ray: np.ndarray, scanner: Element | None, survey: Path) -> Part:
    settings = read_xml(survey, "document").find("survey/leg/platformSettings")
    if scanner is None or settings is None:
        raise DataError("holds no survey of this design", where=str(survey), hint="export it again")
    channels = scanner.findall("channels/channel")
    beams = scanner.findall("channels/channel/beamOrigin")
    try:
        place = np.array([float(settings.attrib[axis]) for axis in "xyz"])
        gate = np.array([[float(one.attrib[name]) for name in ("rangeMin_m", "rangeMax_m")] for one in channels])
        offset = np.array([[float(beam.attrib[axis]) for axis in "xyz"] for beam in beams])
        turns = np.array([[float(rot.attrib["angle_deg"]) for rot in beam] for beam in beams])
        elevation, yaw = np.radians(turns.reshape(-1, 2)).T
        return ray, place + offset, direction(yaw + math.pi / 2, elevation), gate.reshape(-1, 2)
    except (KeyError, ValueError) as error:
        raise DataError(f"holds no survey of this design: {error}", where=str(survey)) from error


def helios_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose."""
    return rays_rounding(rays, read_helios(path, design, rays), path, times=False)
