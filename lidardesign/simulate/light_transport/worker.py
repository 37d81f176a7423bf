"""The rendering process, the only one that imports mitsuba and mitransient.

Every request has numbers and shapes, and names a folder with `request.npz` (arrays); the answer is `result.npz` in that
folder, or an error. A library that aborts ends this process, not the calling one.

Transport (intersections, scattering, several bounces, times of flight) is mitransient's `transient_path`. The sensor, a
list of rays, and the emitter, a list of small lights, are defined here because mitsuba has neither. They implement
mitsuba's protocol; a path's length counts from the ray's origin to the light, plus the light's own lead.
"""

from __future__ import annotations

import json
import sys
import traceback
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lidardesign.run.processes import write_line

RAY_COLUMNS = ("origin", "direction", "cone_cosine_m1", "baseline", "dark_place", "dark_radius")
LIGHT_COLUMNS = (
    "light",
    "light_forward",
    "light_left",
    "light_up",
    "light_cosine",
    "light_left_tan",
    "light_up_tan",
    "light_lambert",
    "light_intensity",
    "light_radius",
    "light_itself",
    "light_lead",
)


class Job:
    """Data that the sensor and the emitter of a request share; its arrays live as long as kernels may read them.

    Arguments:
        mi, dr: mitsuba with its variant set, and drjit.
        arrays: The columns of rays and lights.
        samples: Paths per ray.
        own: Whether ray n sees light n alone; otherwise all of them.
    """

    def __init__(self, mi: Any, dr: Any, arrays: dict[str, np.ndarray], samples: int, own: bool) -> None:
        self._dr, self.samples, self.own = dr, samples, own
        # opaque, so that one kernel serves all numbers of lights
        self.lights = dr.opaque(mi.UInt32, len(arrays["light"]))
        self._columns: dict[str, Any] = {}
        for name in (*RAY_COLUMNS, *LIGHT_COLUMNS):
            values = np.ascontiguousarray(arrays[name].T, dtype=np.float32)
            self._columns[name] = (mi.Float if values.ndim == 1 else mi.Vector3f)(values)

    def at(self, name: str, index: Any) -> Any:
        """A column's values at indices."""
        values = self._columns[name]
        return self._dr.gather(type(values), values, index)


current: list[Job] = []


def register(mi: Any, dr: Any) -> None:
    """Register `lidardesign_rays` and `lidardesign_lights` with mitsuba; they read the job in `current`."""
    mi.register_sensor("lidardesign_rays", _ray_list(mi, dr))
    mi.register_emitter("lidardesign_lights", _lights(mi, dr))


def _ray_list(mi: Any, dr: Any) -> type:
    class RayList(mi.Sensor):
        """Sensor of rays with an origin each, spread evenly within a cone around their directions."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.m_needs_sample_3 = True

        def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
            job = current[0]
            ray = dr.arange(mi.UInt32, dr.width(sample2)) // job.samples
            axis, cosine_m1 = job.at("direction", ray), job.at("cone_cosine_m1", ray)
            # 1 - cos of a narrow cone is kept apart: cos alone would round to 1
            drop, turn = sample3.x * cosine_m1, dr.two_pi * sample3.y
            sine = dr.safe_sqrt(drop * (2 - drop))
            local = mi.Vector3f(sine * dr.cos(turn), sine * dr.sin(turn), 1 - drop)
            spread = dr.normalize(mi.Frame3f(axis).to_world(local))
            direction = dr.select(cosine_m1 > 0, spread, axis)
            # nothing moves: time is free to carry the ray's number along the path, exact below 2^24
            return mi.Ray3f(mi.Point3f(job.at("origin", ray)), direction, mi.Float(ray), []), mi.Spectrum(1)

        def sample_ray_differential(
            self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True
        ) -> Any:
            ray, weight = self.sample_ray(time, sample1, sample2, sample3, active)
            return mi.RayDifferential3f(ray), weight

        def bbox(self) -> Any:
            return mi.BoundingBox3f()

        def to_string(self) -> str:
            return "RayList[]"

    return RayList


def _lights(mi: Any, dr: Any) -> type:
    class Lights(mi.Emitter):
        """Emitter of point lights that shine into a limited solid angle, or everywhere."""

        def __init__(self, properties: Any) -> None:
            super().__init__(properties)
            self.m_flags = mi.EmitterFlags.DeltaPosition

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            job = current[0]
            ray = mi.UInt32(it.time + 0.5)
            chosen = mi.UInt32(sample.x * mi.Float(job.lights))
            index = ray if job.own else dr.minimum(chosen, job.lights - 1)
            place = mi.Point3f(job.at("light", index))
            offset = place - it.p
            distance = dr.norm(offset)
            toward = offset / dr.maximum(distance, dr.smallest(mi.Float))
            # The irradiance of lights at a distance in a direction away from them, on a surface that faces them
            forward, left, up = (dr.dot(-toward, job.at(f"light_{name}", index)) for name in ("forward", "left", "up"))
            inside = (forward >= job.at("light_cosine", index)) & (distance > job.at("light_itself", index))
            inside &= dr.abs(left) <= job.at("light_left_tan", index) * dr.abs(forward)
            inside &= dr.abs(up) <= job.at("light_up_tan", index) * dr.abs(forward)
            intensity = job.at("light_intensity", index)
            intensity *= dr.select(job.at("light_lambert", index) > 0, dr.maximum(forward, 0), 1)
            near = dr.maximum(distance, job.at("light_radius", index))
            strength = dr.select(inside, intensity / dr.square(near), 0)
            dark = dr.norm(it.p - mi.Point3f(job.at("dark_place", ray))) < job.at("dark_radius", ray)
            strength = dr.select(dark, 0, strength)
            if not job.own:
                strength *= mi.Float(job.lights)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p, ds.n, ds.d, ds.time = place, -toward, toward, it.time
            ds.dist = distance + job.at("light_lead", index) - job.at("baseline", ray)
            lit = active & (strength > 0)
            ds.pdf, ds.delta = dr.select(lit, mi.Float(1), 0), mi.Bool(True)
            ds.emitter = mi.EmitterPtr(self)
            return ds, mi.Spectrum(dr.select(lit, strength, 0))

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Spectrum(0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Spectrum(0)

        def bbox(self) -> Any:
            return mi.BoundingBox3f()

        def to_string(self) -> str:
            return "Lights[]"

    return Lights


def _shapes(mi: Any, request: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for number, shape in enumerate(request["shapes"]):
        material = {
            "type": "twosided",
            "inner": {"type": "diffuse", "reflectance": {"type": "uniform", "value": shape["reflectance"]}},
        }
        name = f"body{number}"
        if shape["kind"] == "mesh":
            made[name] = _mesh(mi, name, material, arrays[f"vertices{number}"], arrays[f"faces{number}"])
            continue
        ends, radius = shape["ends"], shape["radius"]
        for end, centre in enumerate(ends[: 1 if ends[0] == ends[1] else 2]):
            made[f"{name}_{end}"] = {"type": "sphere", "center": centre, "radius": radius, "bsdf": material}
        if ends[0] != ends[1]:
            made[name] = {"type": "cylinder", "p0": ends[0], "p1": ends[1], "radius": radius, "bsdf": material}
    return made


def _mesh(mi: Any, name: str, surface: dict[str, Any], vertices: np.ndarray, faces: np.ndarray) -> Any:
    properties = mi.Properties()
    properties["surface"] = mi.load_dict(surface)
    mesh = mi.Mesh(name, vertex_count=len(vertices), face_count=len(faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices, dtype=np.float32).ravel()
    parameters["faces"] = np.ascontiguousarray(faces, dtype=np.uint32).ravel()
    parameters.update()
    return mesh


def _render(mi: Any, dr: Any, request: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    samples, rays = int(request["samples"]), len(arrays["origin"])
    scene = mi.load_dict(
        {
            "type": "scene",
            **_shapes(mi, request, arrays),
            "lights": {"type": "lidardesign_lights"},
            "sensor": {
                "type": "lidardesign_rays",
                "film": {
                    "type": "transient_hdr_film",
                    "width": rays,
                    "height": 1,
                    "rfilter": {"type": "box"},
                    "temporal_bins": int(request["bins"]),
                    "bin_width_opl": float(request["width_m"]),
                },
                "sampler": {"type": "independent", "sample_count": samples},
            },
        }
    )
    # a path of n surfaces has depth n + 1, the light counted
    depth = int(request["bounces"]) + 1
    integrator = mi.load_dict({"type": "transient_path", "max_depth": depth, "rr_depth": depth})
    current[:] = [Job(mi, dr, arrays, samples, bool(request["own"]))]
    steady, transient = integrator.render(scene, seed=int(request["seed"]), spp=samples)
    binned = np.asarray(transient)[0, :, :, 0]
    ray, cell = np.nonzero(binned)
    return {"ray": ray, "cell": cell, "radiance": binned[ray, cell], "steady": np.asarray(steady)[0, :, 0]}


def serve(_: object, answers: BinaryIO) -> dict[str, Any]:
    """Answer requests, one in each line, until standard input ends."""
    import drjit as dr
    import mitsuba as mi

    # plain float32 on the CPU, one channel: light of one wavelength
    mi.set_variant("llvm_ad_mono")
    import mitransient  # noqa: F401 (registers its integrator and film)

    register(mi, dr)
    for line in sys.stdin:
        request, found = json.loads(line), {}
        folder = Path(request["folder"])
        try:
            with np.load(folder / "request.npz", allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            np.savez(folder / "result.npz", **_render(mi, dr, request, arrays))
        except Exception as error:
            # any failure in here is reported by the calling process
            found = {"error": traceback.format_exception_only(error)[-1].strip()}
        write_line(answers, found)
    return {}
