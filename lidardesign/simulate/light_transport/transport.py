"""Transients of a scene by a light-transport simulator (mitsuba with mitransient), where it is installed.

It renders the radiance that arrives along each ray, by the length of the whole path from the light to the ray's
origin. Conventions: reflection is Lambertian (reflectance / pi), surfaces are two-sided and shaded
by their geometric normals, the air is empty, nothing moves within a frame. A light has an intensity I [W/sr]; a matt
point at distance d from it, whose normal is turned by theta, has the radiance L = reflectance * I * cos(theta) /
(pi d^2). By Helmholtz's reciprocity light may be sent either way: with I = 1 W/sr at a *receiver*, the radiance seen
along a *beam* is the beam's gain, the share of its light that reaches 1 m^2 of aperture (`Echoes.gain`).

A frame of a scene becomes shapes in float32 around a centre of its own: spheres and the sides of capsules stay exact,
boxes become twelve triangles. An infinite plane is cut where little light comes from: it is as large as
`PLANE_REACHES` times the distance to the rays' hits, in nested squares that grow outward, so that near parts keep their
accuracy.

With the wrong LLVM the simulator aborts its whole process, so it runs in a process of its own, kept for the next
request: importing and compiling take most of the time of a small one. Arrays are exchanged as files in a temporary
folder, without pickle.
"""

from __future__ import annotations

import atexit
import importlib.metadata
import importlib.util
import math
import os
import re
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from lidardesign.errors import ConfigError, NumericalError
from lidardesign.run.processes import Child, ChildError
from lidardesign.scenes.casting import shared_caster
from lidardesign.scenes.rays import Hits, Rays, receiver_axes
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Plane, Receiver, Scene, Sphere
from lidardesign.scenes.surface import BOX_CORNERS, BOX_QUADS, round_triangles

# Half sizes of a plane's nested squares, in reaches. Parts further out send back less than 1e-4 of its light.
PLANE_REACHES = (2.0, 10.0, 100.0)
ROUND_STEPS = 360  # round cylinders and ellipsoids, which the renderer takes as meshes: flat sides half a degree off
_SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)


def scene_shapes(
    scene: Scene, frame: int, centre_m: np.ndarray, reach_m: float
) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Shapes of a frame as JSON, and their arrays; light that is mirrored or transmitted is lost.

    Arguments:
        scene: The scene; all of its bodies, whatever their role.
        frame: The time frame.
        centre_m: The new origin, shape (3,) [m].
        reach_m: Distance of the furthest end or hit of a path from it [m].
    """
    shapes, arrays = [], {}
    for number, body in enumerate(scene.bodies):
        document, own = _shape(body, frame, centre_m, reach_m)
        shapes.append({**document, "reflectance": float(body.reflectance)})
        arrays.update({f"{name}{number}": values for name, values in own.items()})
    return shapes, arrays


def _shape(
    body: Body, frame: int, centre_m: np.ndarray, reach_m: float
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    pose, shape = body.pose(frame), body.shape
    rotation, place = pose[:3, :3], pose[:3, 3] - centre_m
    if isinstance(shape, Sphere):
        return _round([place, place], shape.radius_m), {}
    if isinstance(shape, Capsule):
        half = shape.half_length_m * rotation[:, 2]
        return _round([place - half, place + half], shape.radius_m), {}
    if isinstance(shape, Plane):
        nearest = rotation[:, 2] * (rotation[:, 2] @ place)
        vertices, faces = _plane(max(reach_m, float(np.linalg.norm(nearest))))
        return {"kind": "mesh"}, {"vertices": vertices @ rotation.T + nearest, "faces": faces}
    if isinstance(shape, Box):
        vertices, faces = BOX_CORNERS * np.array(shape.half_extents_m), _split(BOX_QUADS)
    elif isinstance(shape, Cylinder | Ellipsoid):
        vertices, faces = round_triangles(shape, ROUND_STEPS)
    else:
        vertices, faces = shape.vertices, shape.faces
    return {"kind": "mesh"}, {"vertices": vertices @ rotation.T + place, "faces": faces}


def _round(ends: list[np.ndarray], radius_m: float) -> dict[str, Any]:
    return {"kind": "round", "ends": [end.tolist() for end in ends], "radius": float(radius_m)}


def _plane(reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of nested squares in the plane z = 0 around the origin."""
    rings = [_SQUARE * (reaches * reach_m) for reaches in PLANE_REACHES]
    quads = [(0, 1, 2, 3)]
    for ring in range(len(rings) - 1):
        inner, outer = 4 * ring, 4 * (ring + 1)
        quads += [(outer + k, outer + (k + 1) % 4, inner + (k + 1) % 4, inner + k) for k in range(4)]
    return np.concatenate(rings), _split(quads)


def _split(quads: Any) -> np.ndarray:
    return np.array([[a, b, c] if half == 0 else [a, c, d] for a, b, c, d in quads for half in (0, 1)], dtype=np.int32)


# Rays of one request: limits memory, and the numbers of rays that kernels are compiled for.
CHUNK_RAYS = 16_384
CHUNK_VALUES = 1 << 23
FEWEST_RAYS = 16
EVERYWHERE = -2.0  # a cosine that every direction exceeds
# Points closer than this share of the reach are one: some hundred times the rounding of float32 paths.
SAME_PLACE = 1e-4


@dataclass(frozen=True, eq=False)
class Lights:
    """M point lights with limited solid angles, as of the laser or, by reciprocity, of the receiver.

    Arguments:
        origin_m: Positions [m], shape (M, 3).
        axes: Forward, left and up of each as rows, shape (M, 3, 3).
        intensity: Intensity in the forward direction [W/sr], shape (M,).
        least_cosine: Directions closer than this to forward are lit, shape (M,).
        tangents: Limits of |left| / forward and |up| / forward, infinite for none, shape (M, 2).
        lambertian: Whether the intensity falls with the cosine from forward, shape (M,).
        radius_m: Size of the patch that a point represents, within which light grows no stronger [m], shape (M,).
        lead_m: Path length of the light before this point [m], shape (M,).
    """

    origin_m: np.ndarray
    axes: np.ndarray
    intensity: np.ndarray
    least_cosine: np.ndarray
    tangents: np.ndarray
    lambertian: np.ndarray
    radius_m: np.ndarray
    lead_m: np.ndarray

    @classmethod
    def beams(cls, hits: Hits, rays: Rays, reflectance: np.ndarray, radius_m: np.ndarray) -> Lights:
        """Patches lit by thin beams of 1 W each: matt points at first hits with the reflected power.

        Arguments:
            hits: First hits of the rays; all of them hit something.
            rays: The beams, M of them.
            reflectance: Reflectance at each hit, shape (M,).
            radius_m: Radius of each patch [m], shape (M,).
        """
        return replace(
            cls.everywhere(rays.origin_m + hits.range_m[:, None] * rays.direction, hits.normal, 1.0),
            intensity=reflectance / math.pi,
            least_cosine=np.zeros(len(rays)),
            lambertian=np.ones(len(rays), dtype=bool),
            radius_m=radius_m,
            lead_m=hits.range_m,
        )

    @classmethod
    def receiver(cls, receiver: Receiver) -> Lights:
        """A fixed receiver as a light, by reciprocity: 1 W/sr within its field of view."""
        axes = receiver_axes(receiver)
        made = cls.everywhere(np.asarray(receiver.origin_m)[None], axes[:1], 1.0)
        return replace(
            made,
            axes=axes[None],
            least_cosine=np.zeros(1),
            tangents=np.tan([[receiver.horizontal_rad / 2, receiver.vertical_rad / 2]]),
        )

    @classmethod
    def everywhere(cls, origin_m: np.ndarray, forward: np.ndarray, intensity: float) -> Lights:
        """Isotropic lights at points (M, 3) [m] with axes along `forward` and this intensity [W/sr]."""
        count = len(origin_m)
        zeros = np.zeros(count)
        return cls(
            np.asarray(origin_m, dtype=float),
            _axes(np.broadcast_to(np.asarray(forward, dtype=float), (count, 3))),
            np.full(count, float(intensity)),
            np.full(count, EVERYWHERE),
            np.full((count, 2), np.inf),
            np.zeros(count, dtype=bool),
            zeros,
            zeros,
        )


@dataclass(frozen=True)
class PathBins:
    """Equal bins of path length.

    Arguments:
        width_m: Width of a bin in whole path, there and back [m].
        count: Number of bins.
        start_m: Start of the first bin [m], for all rays or for each, shape (N,).
    """

    width_m: float
    count: int
    start_m: float | np.ndarray = 0.0

    @property
    def centres_m(self) -> np.ndarray:
        """Centres of the bins [m], shape (count,), where they start alike for all rays."""
        return self.start_m + (np.arange(self.count) + 0.5) * self.width_m


@dataclass(frozen=True, eq=False)
class Transients:
    """Radiance along N rays by path length.

    Arguments:
        bins: The bins of path length.
        ray, cell: Indices of rays and bins with light, each pair once, shape (K,).
        radiance: Radiance for lights in W/sr, shape (K,) [W / (m^2 sr)].
        steady: Total radiance of each ray, also outside of the bins, shape (N,) [W / (m^2 sr)].
    """

    bins: PathBins
    ray: np.ndarray
    cell: np.ndarray
    radiance: np.ndarray
    steady: np.ndarray


def render_transient(
    scene: Scene,
    frame: int,
    rays: Rays,
    lights: Lights,
    bins: PathBins,
    *,
    bounces: int = 1,
    samples: int = 1,
    seed: int = 0,
    direct: bool = True,
    own_light: bool = False,
    cone_sr: np.ndarray | None = None,
) -> Transients:
    """Render the transients along rays of light reflected by 1 to `bounces` surfaces.

    Arguments:
        scene: The scene.
        frame: The time frame.
        rays: The viewing rays, N of them, at least one; gates are ignored.
        lights: The lights, M of them, at least one.
        bins: Bins of path length.
        bounces: Most surfaces on a path: 1 is the direct component, exact for thin rays, one light, one sample.
        samples: Light paths per ray; standard errors fall with its root.
        seed: Seed of the simulator's random numbers; a ray's depend on its index in the list, and on samples and bins.
        direct: Whether to include light reflected by a single surface.
        own_light: Whether ray n sees light n alone; otherwise all of them.
        cone_sr: Solid angle around each ray over which radiance is averaged [sr], shape (N,); None: thin rays.

    Raises:
        ConfigError: The simulator is not usable here.
        NumericalError: It died or took too long.
    """
    count = len(rays)
    first = shared_caster(scene, frame).first_hit(rays.origin_m, rays.direction)
    centre_m, reach_m = _neighbourhood(first, rays, lights)
    shapes, arrays = scene_shapes(scene, frame, centre_m, reach_m)
    origin = rays.origin_m - centre_m
    columns = {
        "origin": origin,
        "direction": rays.direction,
        "dark_place": origin + np.where(np.isfinite(first.range_m), first.range_m, 0.0)[:, None] * rays.direction,
        "cone_cosine_m1": np.zeros(count) if cone_sr is None else np.asarray(cone_sr) / (2 * math.pi),
        "baseline": np.zeros(count) + bins.start_m,
        "dark_radius": np.full(count, 0.0 if direct else SAME_PLACE * reach_m),
    }
    request = {
        "shapes": shapes,
        "samples": samples,
        "bins": bins.count,
        "width_m": bins.width_m,
        "bounces": bounces,
        "own": own_light,
    }
    light_columns = {
        "light": lights.origin_m - centre_m,
        "light_forward": lights.axes[:, 0],
        "light_left": lights.axes[:, 1],
        "light_up": lights.axes[:, 2],
        "light_cosine": lights.least_cosine,
        "light_left_tan": lights.tangents[:, 0],
        "light_up_tan": lights.tangents[:, 1],
        "light_lambert": lights.lambertian.astype(float),
        "light_intensity": lights.intensity,
        "light_radius": lights.radius_m,
        # a patch does not light itself
        "light_itself": np.where(lights.lambertian, SAME_PLACE * reach_m, 0.0),
        "light_lead": lights.lead_m,
    }
    arrays |= light_columns
    by_ray = columns | (light_columns if own_light else {})
    # the answers of all requests, without the padding rays of the last
    parts = []
    for number, rows in enumerate(_chunks(count, bins.count)):
        mine = arrays | {name: values[rows] for name, values in by_ray.items()}
        found = ask({**request, "seed": int(np.random.SeedSequence([seed, number]).generate_state(1)[0])}, mine)
        parts.append({**found, "ray": found["ray"] + rows[0]})
    ray, cell, radiance, steady = (
        np.concatenate([part[name] for part in parts]) for name in ("ray", "cell", "radiance", "steady")
    )
    real = ray < count
    return Transients(bins, ray[real], cell[real], radiance[real].astype(float), steady[:count].astype(float))


def _neighbourhood(first: Hits, rays: Rays, lights: Lights) -> tuple[np.ndarray, float]:
    """Centre (3,) of all ends and first hits of paths, and the distance of the furthest from it [m]."""
    seen = np.isfinite(first.range_m)
    points = rays.origin_m[seen] + first.range_m[seen, None] * rays.direction[seen]
    points = np.concatenate([points, rays.origin_m, lights.origin_m])
    centre_m = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre_m, float(np.linalg.norm(points - centre_m, axis=1).max())


def _chunks(count: int, bins: int) -> list[np.ndarray]:
    """Split rays into requests; the last is padded with its last ray to a power of two, to reuse compiled kernels."""
    size = max(FEWEST_RAYS, min(CHUNK_RAYS, CHUNK_VALUES // bins))
    chunks = [np.arange(start, min(start + size, count)) for start in range(0, count, size)]
    last = chunks[-1]
    full = max(FEWEST_RAYS, 1 << (len(last) - 1).bit_length())
    return [*chunks[:-1], np.concatenate([last, np.full(full - len(last), last[-1])])]


def _axes(forward: np.ndarray) -> np.ndarray:
    """Forward, left and up axes as rows for forward directions (M, 3), shape (M, 3, 3)."""
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    # the coordinate axis that is furthest from forward cannot be parallel to it
    left = np.cross(np.eye(3)[np.abs(forward).argmin(axis=1)], forward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return np.stack([forward, left, np.cross(forward, left)], axis=1)


WORKER = "lidardesign.simulate.light_transport.worker:serve"
# The simulator's packages and the oldest versions that answer as its tests expect.
PACKAGES = {"mitsuba": (3, 9), "mitransient": (1, 3), "drjit": (1, 0)}
# Older ones cannot select instructions for the kernels and abort (14 to 16), or are refused.
OLDEST_LLVM = 19
LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64/llvm*/lib",
)
LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
TIME_LIMIT_S = 600.0
HINT = (
    "pip install 'lidardesign[transport]' and an LLVM library of version 19 or newer (Debian, Ubuntu: apt install "
    f"libllvm19), or name one in {LLVM_VARIABLE}"
)
# Lines of the simulator's output in an error message: those that name an error, or else the last ones.
SHOWN_LINES = 4


def missing() -> str | None:
    """Reason why the simulator cannot run here, in one line, or None; imports nothing of it."""
    absent = [name for name in PACKAGES if importlib.util.find_spec(name) is None]
    if absent:
        return f"not installed: {', '.join(absent)}"
    for name, oldest in PACKAGES.items():
        found = importlib.metadata.version(name)
        if tuple(int(part) for part in re.findall(r"\d+", found)[:2]) < oldest:
            return f"{name} {found} is too old: {'.'.join(map(str, oldest))} or newer is needed"
    if llvm_library() is None:
        place = os.environ.get(LLVM_VARIABLE) or "where systems have it"
        return f"no LLVM library of version {OLDEST_LLVM} or newer: {place}"
    return None


def llvm_library() -> str | None:
    """Path of the LLVM library named by the environment, else of the newest usable one; None if there is none."""
    named = os.environ.get(LLVM_VARIABLE)
    if named:
        version = llvm_version(Path(named).name)
        return named if Path(named).is_file() and (version is None or version >= OLDEST_LLVM) else None
    return _newest_installed()


@lru_cache(maxsize=1)
def _newest_installed() -> str | None:
    found = {}
    for folder in LLVM_FOLDERS:
        for path in Path("/").glob(f"{folder[1:]}/libLLVM*.so*"):
            version = llvm_version(path.name)
            if version is not None and version >= OLDEST_LLVM and path.exists():
                found.setdefault(version, str(path))
    return found[max(found)] if found else None


def llvm_version(file_name: str) -> int | None:
    """The major version in a library's file name: libLLVM-19.so, libLLVM.so.19.1, libLLVM-14.0.6.so.1."""
    match = re.match(r"libLLVM-(\d+)|libLLVM\.so\.(\d+)", file_name)
    return int(match.group(1) or match.group(2)) if match else None


def ask(
    request: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, limit_s: float = TIME_LIMIT_S
) -> dict[str, np.ndarray]:
    """Send one request to the simulator and return its answer.

    Arguments:
        request: Numbers and shapes, as JSON.
        arrays: Arrays by name.
        limit_s: Time limit of the answer [s].

    Raises:
        ConfigError: The simulator is not usable here.
        NumericalError: It failed, died, or took too long; the message says which and why.
    """
    with tempfile.TemporaryDirectory(prefix="lidardesign-light-") as name:
        folder = Path(name)
        np.savez(folder / "request.npz", **arrays)
        with _one_at_a_time:
            reason = missing()
            if reason is not None:
                raise ConfigError(f"the light-transport simulator cannot run: {reason}", hint=HINT)
            if not _running or not _running[0].alive:
                end_worker()
                _running[:] = [Child(WORKER, None, {LLVM_VARIABLE: str(llvm_library())})]
            worker = _running[0]
            worker.send({"folder": name, **request})
            try:
                found = worker.answer(limit_s, "while it renders")
            except ChildError as lost:
                end_worker()
                lines = [line for line in worker.printed if line.strip()]
                said = "\n".join(([line for line in lines if "error" in line.lower()] or lines)[-SHOWN_LINES:])
                raise NumericalError(
                    f"the light-transport simulator {lost}" + (f"; it said:\n{said}" if said else ""),
                    hint="fewer rays, samples or bounces" if lost.reason == "late" else HINT,
                ) from None
        if "error" in found:
            raise NumericalError(
                f"the light-transport simulator failed: {found['error']}", hint="report it with the scene"
            )
        with np.load(folder / "result.npz", allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}


_running: list[Child] = []
_one_at_a_time = threading.Lock()


def end_worker() -> None:
    """End the simulator's process, if this process runs one."""
    for worker in _running:
        if worker.owner == os.getpid():
            worker.end()
    _running.clear()


atexit.register(end_worker)
