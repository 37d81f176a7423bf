"""Scenes for Mitsuba 3 with mitransient: per sensor a film of gated histograms, its rays, and the light beside it.

One radiancemeter per ray, all of them in a batch, one pixel each: directions are held exactly, whatever the layout. The
light is a point at the sensor, so light straight there and back has the optical path length of twice the range, and a
film that listens from twice the gate's start in bins of c times their duration is the gate. Scenes hold no shapes.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lidardesign.design.bandwidth import Bandwidth
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.estimates import Estimate
from lidardesign.export.common.names import child, document, element, read_xml, write_folder
from lidardesign.export.common.poses import (
    Part,
    Place,
    design_losses,
    mounts,
    places,
    rays_of_parts,
    rays_rounding,
    require_rays,
)
from lidardesign.geometry.rays import Rays
from lidardesign.numerics import unit_vectors

SUFFIX = ".xml"
SAMPLES = 64
# From the light to a surface and back to the sensor.
DEPTH = 2
MM_PER_M = 1000


def write_mitsuba(design: DesignSpec, rays: Rays, path: Path) -> list[str]:
    """Write the folder; returns notes of what the format cannot hold.

    Raises:
        DataError: The design has no rays, or the folder cannot be written.
    """
    require_rays(design, rays, "a film")
    mounted = mounts(design, rays)
    found = places(mounted, rays)
    notes = write_folder(path, {f"{one.name}{SUFFIX}": document(_scene(one, rays)) for one in found})
    notes += [
        "scenes hold no shapes: include one of them in yours, or yours in it; each sensor is a scene of its own",
        f"the light is one flash for all rays: only light straight there and back (max_depth {DEPTH}) is the ray's own",
        f"gates end on whole bins of {MM_PER_M * Bandwidth().bin_m:.1f} mm; times within the frame are not held",
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


def _gate_m(rays: Rays, place: Place) -> tuple[float, float]:
    """The narrowest gate that holds those of all rays of a place: start and end."""
    gate = rays.gate_m[place.ray]
    return float(gate[:, 0].min()), float(gate[:, 1].max())


def _scene(place: Place, rays: Rays) -> Element:
    """Integrator, rays with their film, and light."""
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
    """One pixel per ray, and the gate that they share as optical path lengths."""
    readout = Bandwidth()
    start, end = _gate_m(rays, place)
    film = child(batch, "film", type="transient_hdr_film")
    for name, value in (
        ("width", len(place.ray)), ("height", 1), ("temporal_bins", int(readout.bins(end - start))),
    ):  # fmt: skip
        child(film, "integer", name=name, value=value)
    child(film, "float", name="start_opl", value=2 * start)
    child(film, "float", name="bin_width_opl", value=2 * readout.bin_m)
    child(film, "rfilter", type="box")


def _add_vector(parent: Element, tag: str, name: str, values: np.ndarray) -> None:
    x, y, z = values.tolist()
    child(parent, tag, name=name, x=x, y=y, z=z)


def read_mitsuba(path: Path, design: DesignSpec, rays: Rays) -> Rays:
    """The rays of a folder that `write_mitsuba` made of a design and its rays, with their sensors and times.

    Raises:
        DataError: The folder cannot be read, or holds something else.
    """
    found = places(mounts(design, rays), rays)
    return rays_of_parts(rays, [_part(one, Path(path) / f"{one.name}{SUFFIX}") for one in found], str(path))


def _part(place: Place, path: Path) -> Part:
    root = read_xml(path, "scene")
    numbers = {one.get("name"): float(one.get("value", "nan")) for one in root.findall("sensor/film/*[@value]")}
    try:
        origin, looking = (
            np.array([[float(one.attrib[axis]) for axis in "xyz"] for one in root.findall(f"sensor/sensor/{tag}")])
            for tag in ("point", "vector")
        )
        start, bins, width = (numbers[name] for name in ("start_opl", "temporal_bins", "bin_width_opl"))
        gate = np.tile([start / 2, (start + bins * width) / 2], (len(origin), 1))
        return place.ray, origin.reshape(-1, 3), unit_vectors(looking.reshape(-1, 3)), gate
    except (KeyError, ValueError) as error:
        raise DataError(f"holds no sensor of this design: {error}", where=str(path), hint="export it again") from error


def mitsuba_rounding(design: DesignSpec, rays: Rays, path: Path) -> dict[str, Estimate]:
    """What the written numbers lose, gates on whole bins that rays share included."""
    return rays_rounding(rays, read_mitsuba(path, design, rays), path, times=False)
