"""Simulators that trace every ray by itself: HELIOS++, Mitsuba 3 and Robotec GPU Lidar.

Scanner, platform and survey files for HELIOS++: one scanner per sensor, one channel per ray, one pulse of each.

HELIOS++ fires along the y axis of a scanner and turns it by the channel's rotations about fixed axes: about x by the
elevation, then about z by the azimuth less a quarter turn. Channels start at their own offset from the platform and
have their own range limits, so any list of rays with any gates can be written. A leg ends when the head has turned far
enough: it turns by one degree before the only pulse, from -1 to 0, and the leg ends there.

Version 2 focuses the beam at the start of its gate: with a range R and a start R0, the emitted power grows with
(1 - R / R0) to the power of -2, so a start of 0 emits none. The wider the beam, the smaller the effect.

Scenes for Mitsuba 3 with mitransient: per sensor a film of gated histograms, its rays, and a light at its origin.

One radiancemeter per ray, all of them in a batch, one pixel each: directions are exact for any layout. The light is a
point at the sensor, so direct light has an optical path length of twice the range, and a film from twice the gate's
start in bins of c times their duration is the gate. Scenes hold no shapes.

Ray patterns for Robotec GPU Lidar and its Gazebo plugin: a pattern file per sensor, and the model that uses them.

A pattern is one row-major 3 x 4 float32 matrix per ray, its pose in the sensor's frame (x forward, y left, z up); the
ray looks along the third axis of its pose. The plugin has one range for all rays of a sensor and fires them at once;
the library's own calls take a range and a time per ray, for which there are the `.range2f` files (pairs of float32,
metres) and the `.time1f` files (float32, milliseconds).
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lidardesign.formats import RATE, RAYS, Format, WriteOptions
from lidardesign.formats.mounts import (
    Mount,
    Place,
    design_losses,
    fire_times_s,
    gate_losses,
    mounts,
    near_losses,
    places,
    require_rays,
)
from lidardesign.formats.names import child, document, element, identifier, numbers, renamed_note
from lidardesign.run.files import write_folder
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import SPEED_OF_LIGHT_M_S
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import angles

SCANNERS, PLATFORMS, SURVEY, SCENE = "scanners.xml", "platforms.xml", ".survey.xml", "scene.xml#scene"
# HELIOS++ drops echoes whose rise begins before the gate does: a short pulse, in fine bins, loses little. Half a bin
# more than ten, because some versions count one too few: then no bin of the pulse lies behind the waveform's end.
PULSE_NS, BIN_NS = 0.0105, 0.001
# A pulse is t^2 exp(-7 t / pulse): its rise lasts that part of it.
RISE = 2 / 7
# Window of the peak search.
WINDOW_NS = 2.5 * BIN_NS
# HELIOS++ 2 emits no power through a gate from 0.
LEAST_START_M = 0.001
# The divergence is that of a common scanner, though beams have no width: at the default of 0.3 mrad a least start sends
# 10,000 times less power. So much power finds a tenth of the light at 60 degrees from 100 m, in every version.
DIVERGENCE_RAD, POWER_W = 0.003, 1000.0
NS_PER_S = 1e9
MM_PER_M = 1000


def write_helios(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the folder cannot be written.
    """
    require_rays(design, rays, "a HELIOS++ scanner")
    pulse_hz = max(round(options.rate_hz), 1)
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
    lost_m = RISE * PULSE_NS / NS_PER_S * SPEED_OF_LIGHT_M_S
    notes = [
        *write_folder(path, {SCANNERS: document(scanners), PLATFORMS: document(platforms), **surveys}),
        f"the surveys name the scene {SCENE}: put yours beside them, and give the folder to helios as --assets",
        f"HELIOS++ drops returns up to {MM_PER_M * lost_m:.1f} mm behind a gate's start: the rise of a pulse of "
        f"{PULSE_NS} ns must begin inside",
        "all rays of a frame fire at once: their times within the frame are lost",
        *near_losses(rays.gate_m[:, 0], LEAST_START_M, "rays", "HELIOS++ 2 sends no power through a gate from 0"),
    ]
    if pulse_hz != options.rate_hz:
        notes.append(f"{options.rate_hz:g} frames per second became {pulse_hz}: HELIOS++ takes whole numbers only")
    return [*notes, *design_losses(design, mounted)]


HELIOS = Format(
    "helios",
    ".helios",
    "a scanner per sensor with a channel per ray, and surveys of one frame each",
    write_helios,
    reader="HELIOS++",
    checked="valid by schemas of its fields; a twin of HELIOS++ fires the rays and finds their echoes",
    holds=frozenset({RAYS, RATE}),
    is_folder=True,
)


def _add_scanner(root: Element, mount: Mount, rays: Rays, pulse_hz: int) -> None:
    """Append the scanner of one sensor, its rays as channels with origins relative to the first one's."""
    scanner = child(
        root, "scanner", id=mount.name, name=mount.sensor.name, optics="rotating",
        beamDivergence_rad=DIVERGENCE_RAD, averagePower_w=POWER_W, pulseFreqs_Hz=pulse_hz, pulseLength_ns=PULSE_NS,
        scanAngleMax_deg=1, scanAngleEffectiveMax_deg=1, scanFreqMin_Hz=0, scanFreqMax_Hz=0, maxNOR=1,
        headRotatePerSecMax_deg=pulse_hz,
    )  # fmt: skip
    child(scanner, "FWFSettings", beamSampleQuality=1, binSize_ns=BIN_NS, winSize_ns=WINDOW_NS)
    child(scanner, "headRotateAxis", x=0, y=0, z=1)
    channels = child(scanner, "channels")
    azimuth_deg, elevation_deg = (np.degrees(values) for values in angles(rays.direction))
    for number, (x, y, z) in enumerate((rays.origin_m - rays.origin_m[0]).tolist()):
        start, end = np.maximum(rays.gate_m[number], LEAST_START_M).tolist()
        origin = child(
            child(channels, "channel", id=number, rangeMin_m=start, rangeMax_m=end), "beamOrigin", x=x, y=y, z=z
        )
        child(origin, "rot", axis="x", angle_deg=float(elevation_deg[number]))
        child(origin, "rot", axis="z", angle_deg=float(azimuth_deg[number] - 90.0))


SCENE_SUFFIX = ".xml"
SAMPLES = 64
# From the light to a surface and back to the sensor.
DEPTH = 2


def write_mitsuba(design: DesignSpec, rays: Rays, path: Path, _: object = None) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the folder cannot be written.
    """
    require_rays(design, rays, "a film")
    mounted = mounts(design, rays)
    found = places(mounted, rays)
    notes = [
        *write_folder(path, {f"{one.name}{SCENE_SUFFIX}": document(_scene(one, rays)) for one in found}),
        "scenes hold no shapes: include one of them in yours, or yours in it; each sensor is a scene of its own",
        f"the light is one flash for all rays: only light straight there and back (max_depth {DEPTH}) is the ray's own",
        f"gates end on whole bins of {MM_PER_M * Bandwidth().bin_m:.1f} mm; times within the frame are lost",
    ]
    # a film has one gate
    wider = np.concatenate([np.abs(rays.gate_m[one.ray] - _gate_m(rays, one)).max(axis=1) for one in found])
    if wider.any():
        notes.append(
            f"{np.count_nonzero(wider)} of {len(rays)} rays have gates of their own: their film has the narrowest gate "
            f"that holds all of its rays, up to {wider.max():.3g} m wider"
        )
    if len(found) > len(mounted):
        notes.append(f"rays of {len(mounted)} sensors start at {len(found)} places: each is a scene of its own")
    return [*notes, *design_losses(design, mounted)]


MITSUBA = Format(
    "mitsuba",
    ".mitsuba",
    "a scene per sensor: gated film, rays as radiancemeters, a flash beside them",
    write_mitsuba,
    reader="Mitsuba 3 with mitransient",
    checked="rendered by them: light comes back in the bin of its range",
    is_folder=True,
)


def _gate_m(rays: Rays, place: Place) -> tuple[float, float]:
    """Start and end of the narrowest gate that contains those of all rays of a place [m]."""
    gate = rays.gate_m[place.ray]
    return float(gate[:, 0].min()), float(gate[:, 1].max())


def _scene(place: Place, rays: Rays) -> Element:
    """Scene of a place: integrator, rays with their film, and light."""
    root = element("scene", {"version": "3.0.0"})
    child(child(root, "integrator", type="transient_path"), "integer", name="max_depth", value=DEPTH)
    batch = child(root, "sensor", type="batch", id=place.name)
    _add_film(batch, place, rays)
    child(child(batch, "sampler", type="independent"), "integer", name="sample_count", value=SAMPLES)
    for number, ray in enumerate(place.ray.tolist()):
        meter = child(batch, "sensor", type="radiancemeter", id=f"{place.name}_ray_{number}")
        _add_vector(meter, "point", "origin", rays.origin_m[ray])
        _add_vector(meter, "vector", "direction", rays.direction[ray])
        film = child(meter, "film", type="hdrfilm")
        for side in ("width", "height"):
            child(film, "integer", name=side, value=1)
        child(film, "rfilter", type="box")
    light = child(root, "emitter", type="point", id=f"{place.name}_light")
    _add_vector(light, "point", "position", place.origin_m)
    child(light, "spectrum", name="intensity", value=1.0)
    return root


def _add_film(batch: Element, place: Place, rays: Rays) -> None:
    """Append a film with a pixel per ray and their common gate as optical path lengths."""
    start, end = _gate_m(rays, place)
    film = child(batch, "film", type="transient_hdr_film")
    for name, value in (
        ("width", len(place.ray)), ("height", 1), ("temporal_bins", int(Bandwidth().bins(end - start))),
    ):  # fmt: skip
        child(film, "integer", name=name, value=value)
    child(film, "float", name="start_opl", value=2 * start)
    child(film, "float", name="bin_width_opl", value=2 * Bandwidth().bin_m)
    child(film, "rfilter", type="box")


def _add_vector(parent: Element, tag: str, name: str, values: np.ndarray) -> None:
    x, y, z = values.tolist()
    child(parent, tag, name=name, x=x, y=y, z=z)


MODEL, PATTERN, RANGES, TIMES = "model.sdf", ".mat3x4f", ".range2f", ".time1f"
MS_PER_S = 1000.0


def write_rgl(design: DesignSpec, rays: Rays, path: Path, options: WriteOptions) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the folder cannot be written.
    """
    require_rays(design, rays, "a ray pattern")
    mounted = mounts(design, rays)
    root = element("sdf", {"version": "1.9"})
    model = child(root, "model", name=identifier(design.name))
    child(model, "static", text=True)
    link = child(model, "link", name="lidar")
    files = {}
    times_ms = MS_PER_S * fire_times_s(rays, options.rate_hz)
    for mount in mounted:
        files[f"{mount.name}{TIMES}"] = times_ms[mount.ray].astype("<f4").tobytes()
        files[f"{mount.name}{PATTERN}"] = _matrices(mount, rays.subset(mount.ray)).astype("<f4").tobytes()
        files[f"{mount.name}{RANGES}"] = rays.gate_m[mount.ray].astype("<f4").tobytes()
        # A sensor with the plugin that fires its pattern
        sensor = child(link, "sensor", name=mount.name, type="custom")
        child(sensor, "pose", text=numbers([*rays.origin_m[mount.ray[0]], *mount.roll_pitch_yaw_rad]))
        plugin = child(sensor, "plugin", filename="RGLServerPluginInstance", name="rgl::RGLServerPluginInstance")
        start, end = mount.gate_m
        limits = child(plugin, "range")
        child(limits, "min", text=start)
        child(limits, "max", text=end)
        settings = {
            "update_rate": float(options.rate_hz),
            "update_on_paused_sim": False,
            "topic": f"rgl/{mount.name}",
            "frame": mount.name,
            "pattern_preset_path": path.resolve() / f"{mount.name}{PATTERN}",
        }
        for tag, value in settings.items():
            child(plugin, tag, text=value)
    notes = [
        *write_folder(path, {MODEL: document(root), **files}),
        f"{MODEL} names the patterns by their absolute paths in {path.resolve()}: export again where they move",
        f"the plugin fires all rays of a frame at once; the {TIMES} files hold when each fires, for "
        "rgl_node_rays_set_time_offsets of the library",
        "patterns, gates and times are kept in single precision",
    ]
    for lost in gate_losses(mounted):
        notes += [lost, f"the {RANGES} files hold each ray's own gate, for rgl_node_rays_set_range of the library"]
    names = [design.name, *(mount.sensor.name for mount in mounted)]
    written = [identifier(design.name), *(mount.name for mount in mounted)]
    return [*notes, *renamed_note(names, written), *design_losses(design, mounted)]


RGL = Format(
    "rgl",
    ".rgl",
    "a pattern of float32 ray poses per sensor, and the model with the plugin",
    write_rgl,
    reader="Robotec GPU Lidar and its Gazebo plugin",
    checked="parsed by libsdformat; a twin reads patterns as the plugin does",
    holds=frozenset({RAYS, RATE}),
    is_folder=True,
)


def _matrices(mount: Mount, rays: Rays) -> np.ndarray:
    """Poses of rays in their sensor's frame, with its origin at that of the first ray, shape (K, 3, 4)."""
    looking = rays.direction @ mount.sensor.frame.T
    azimuth, _ = angles(looking)
    across = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(rays))], axis=1)
    offset = (rays.origin_m - rays.origin_m[0]) @ mount.sensor.frame.T
    return np.stack([np.cross(across, looking), across, looking, offset], axis=2)
