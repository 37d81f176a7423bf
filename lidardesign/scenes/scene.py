"""Scenes: bodies with a shape, a role and poses, in metres and a right-handed frame with z up.

Shapes are in their body's own frame; a pose is a 4x4 rigid transform from body to world. Checked meshes come from
`lidardesign.scenes.mesh_files.load_mesh`. Signed distances are positive outside.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from lidardesign.errors import DataError
from lidardesign.numerics import COARSE_SLACK, SLACK
from lidardesign.space import FARTHEST_M

Role = Literal["target", "occluder", "both"]
Sign = Literal["auto", "solid", "winding", "unsigned"]
ROLES = ("target", "occluder", "both")
IDENTITY = np.eye(3)
# Tolerated deviation of a pose's axes from orthonormality: poses are often written with few digits.
RIGID_TOLERANCE = COARSE_SLACK + 10 * COARSE_SLACK * IDENTITY
SPEED_OF_LIGHT_M_S = 299_792_458.0
# Largest extinction or backscatter of a medium: light fades within a nanometre.
DENSEST = 1e9
# A picometre; areas are squares of lengths and must stay normal numbers, as must quotients by them.
SMALLEST_M = 1 / 1e12
# Largest importance; beyond it a density would cover nothing else.
LARGEST_WEIGHT = 1e6
# Shares of light that were meant to add up to 1 may exceed it by rounding.
SHARE_ROUNDING = SLACK


def _check_weights(what: str, weights: np.ndarray, shape: tuple[int, ...] = ()) -> None:
    if weights.shape != shape:
        raise DataError(f"{what}: importance has the shape {weights.shape}", allowed=f"{shape}: one number each")
    wrong = ~((weights >= 1 / LARGEST_WEIGHT) & (weights <= LARGEST_WEIGHT))
    if wrong.any():
        raise DataError(
            f"{what}: importance is {weights[wrong].flat[0]:g}",
            allowed=f"{1 / LARGEST_WEIGHT:g} to {LARGEST_WEIGHT:g}",
            hint="give what does not count at all the role occluder, or leave it out of the mesh",
        )


def _check_lengths(shape: object, *lengths_m: float, low: float = SMALLEST_M) -> None:
    for length in lengths_m:
        if not low <= length <= FARTHEST_M:
            raise DataError(f"{shape} has the length {length} m", allowed=f"lengths from {low:g} to {FARTHEST_M:g} m")


@dataclass(frozen=True)
class Sphere:
    """A ball around the body's origin."""

    radius_m: float

    def __post_init__(self) -> None:
        _check_lengths(self, self.radius_m)


@dataclass(frozen=True)
class Box:
    """A box centred on the body's origin, by its half extents along x, y, z."""

    half_extents_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        _check_lengths(self, *self.half_extents_m)


@dataclass(frozen=True)
class Capsule:
    """All points within a radius of the segment from (0, 0, -half_length) to (0, 0, +half_length)."""

    radius_m: float
    half_length_m: float

    def __post_init__(self) -> None:
        _check_lengths(self, self.radius_m)
        _check_lengths(self, self.half_length_m, low=0.0)


@dataclass(frozen=True)
class Cylinder:
    """A cylinder around the z axis from -half_length to +half_length, flat at both ends."""

    radius_m: float
    half_length_m: float

    def __post_init__(self) -> None:
        _check_lengths(self, self.radius_m, self.half_length_m)


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid centred on the body's origin, by its semi-axes along x, y, z."""

    semi_axes_m: tuple[float, float, float]

    def __post_init__(self) -> None:
        _check_lengths(self, *self.semi_axes_m)


@dataclass(frozen=True)
class Plane:
    """The half space z <= 0, whose surface is the infinite plane z = 0 with the normal +z."""


CLOUD_HINT = "make a mesh of it: Poisson surface reconstruction in MeshLab, CloudCompare or Open3D"


def check_triangles(vertices: np.ndarray, faces: np.ndarray, where: str = "mesh") -> None:
    """Refuse arrays that are no finite vertices (V, 3), and faces (F, 3) of them, at least one.

    Raises:
        DataError: What is wrong, and how many.
    """
    if vertices.size and not faces.size:
        raise DataError(
            f"has {len(vertices)} points and no faces: it is a point cloud or lines, not a mesh",
            where=where,
            hint=CLOUD_HINT,
        )
    if not vertices.size:
        raise DataError("has no faces (an empty or unreadable mesh)", where=where, hint="open it in a mesh viewer")
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise DataError(
            f"vertices and faces have shapes {vertices.shape} and {faces.shape}",
            where=where,
            allowed="(V, 3) and (F, 3)",
        )
    if not np.issubdtype(faces.dtype, np.integer):
        raise DataError(f"faces are of type {faces.dtype}", where=where, allowed="integer vertex indices")
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise DataError(
            f"{bad} of {len(vertices)} vertices are NaN or infinite",
            where=where,
            hint="export the mesh again",
        )
    farthest = float(np.abs(vertices).max())
    if farthest > FARTHEST_M:
        raise DataError(
            f"reaches {farthest:.3g} m",
            where=where,
            allowed=f"within {FARTHEST_M:g} m of the origin",
            hint="is the scale right?",
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = int(((faces < 0) | (faces >= len(vertices))).any(axis=1).sum())
        raise DataError(
            f"{wrong} faces name vertices that do not exist", where=where, allowed=f"0 to {len(vertices) - 1}"
        )


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Arguments:
        vertices: Positions [m], shape (V, 3) float64.
        faces: Vertex indices, shape (F, 3) int32.
        sign: Rule of the sign of distances: `solid` (closed and consistently wound), `winding`
            (generalised winding number beyond +-1/2), `unsigned` (no inside: distances are never negative).
        notes: Repairs and findings of loading, one line each.
        importance: Weight of the surface at each vertex, above 0, shape (V,); between vertices its logarithm is
            interpolated. None: 1 everywhere.
    """

    vertices: np.ndarray
    faces: np.ndarray
    sign: Literal["solid", "winding", "unsigned"] = "solid"
    notes: tuple[str, ...] = ()
    importance: np.ndarray | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        faces = np.asarray(self.faces)
        check_triangles(vertices, faces)
        size = float(np.ptp(vertices, axis=0).max())
        if size < SMALLEST_M:
            raise DataError(f"a mesh is {size:g} m in size", allowed=f"at least {SMALLEST_M:g} m")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", np.ascontiguousarray(faces, dtype=np.int32))
        if self.importance is not None:
            importance = np.ascontiguousarray(self.importance, dtype=np.float64)
            _check_weights(f"a mesh of {len(vertices)} vertices", importance, vertices.shape[:1])
            object.__setattr__(self, "importance", importance)

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 of vertices, faces and sign rule: the key of everything cached about this geometry."""
        digest = hashlib.sha256(self.sign.encode())
        digest.update(self.vertices.tobytes())
        digest.update(self.faces.tobytes())
        return digest.hexdigest()

    @cached_property
    def importance_hash(self) -> str:
        """SHA-256 of the importance, empty without one."""
        return "" if self.importance is None else hashlib.sha256(self.importance.tobytes()).hexdigest()

    @cached_property
    def bounds_m(self) -> np.ndarray:
        """Axis-aligned bounds of the used vertices, shape (2, 3)."""
        mask = np.zeros(len(self.vertices), dtype=bool)
        mask[self.faces] = True
        used = self.vertices[mask]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    def transformed(self, pose: np.ndarray) -> Mesh:
        """The same surface with a rigid 4x4 pose applied to its vertices."""
        return replace(self, vertices=self.vertices @ pose[:3, :3].T + pose[:3, 3])


Round = Sphere | Capsule | Cylinder | Ellipsoid
Shape = Round | Box | Plane | Mesh
Vector = tuple[float, float, float]


def _check_shares(what: str, **shares: float) -> None:
    for name, value in shares.items():
        if not math.isfinite(value) or not 0 <= value <= 1:
            raise DataError(f"{what}: {name} is {value}", allowed="0 to 1")
    if sum(shares.values()) > 1 + SHARE_ROUNDING:
        named = " + ".join(shares)
        raise DataError(f"{what}: {named} is {sum(shares.values()):g}", allowed="at most 1 in all")


@dataclass(frozen=True)
class Medium:
    """Scattering medium: haze, fog, dust.

    Arguments:
        extinction_per_m: Extinction coefficient; light fades as exp(-extinction * length) [1/m].
        backscatter_per_m_sr: Backscatter coefficient [1/(m sr)].
    """

    extinction_per_m: float
    backscatter_per_m_sr: float

    def __post_init__(self) -> None:
        for name in ("extinction_per_m", "backscatter_per_m_sr"):
            value = getattr(self, name)
            if not 0 <= value <= DENSEST:
                raise DataError(f"medium: {name} is {value}", allowed=f"0 to {DENSEST:g}")


@dataclass(frozen=True)
class Ambient:
    """Ambient light.

    Arguments:
        illuminance_lux: Illuminance of the surfaces [lux]; full sunlight has about 100,000, a lit room 300.
        source: Spectrum: `sun`, or `indoor` (white LEDs, which emit little infrared).
    """

    illuminance_lux: float
    source: Literal["sun", "indoor"] = "sun"

    def __post_init__(self) -> None:
        if not math.isfinite(self.illuminance_lux) or self.illuminance_lux < 0:
            raise DataError(f"ambient light of {self.illuminance_lux} lux", allowed="finite, 0 or more")
        if self.source not in ("sun", "indoor"):
            raise DataError(f"ambient light from {self.source!r}", allowed="sun, indoor")


@dataclass(frozen=True)
class Receiver:
    """A fixed, bistatic receiver; without one, every ray is received at its own origin.

    Arguments:
        origin_m: Position [m].
        azimuth_rad, elevation_rad: Direction of its boresight.
        horizontal_rad, vertical_rad: Its whole field of view, angles about its upright and its lateral axis.
        range_m: Interval of distances from it that it receives [m].
    """

    origin_m: Vector
    azimuth_rad: float
    elevation_rad: float
    horizontal_rad: float
    vertical_rad: float
    range_m: tuple[float, float]

    def __post_init__(self) -> None:
        numbers = (*self.origin_m, self.azimuth_rad, self.elevation_rad, *self.range_m)
        if len(self.origin_m) != 3 or not all(math.isfinite(value) for value in numbers):
            raise DataError(f"receiver: {self}", allowed="three finite coordinates, finite angles and ranges")
        for name in ("horizontal_rad", "vertical_rad"):
            if not 0 < getattr(self, name) < math.pi:
                raise DataError(f"receiver: {name} is {getattr(self, name)}", allowed="above 0 and below pi")
        if not 0 <= self.range_m[0] < self.range_m[1]:
            raise DataError(f"receiver: hears from {self.range_m[0]} to {self.range_m[1]} m", allowed="0 <= low < high")


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body in a scene.

    Arguments:
        shape: Its geometry in its own frame.
        name: Name in messages and reports.
        role: `target` is a surface to observe, `occluder` blocks rays, `both` does both.
        poses: Body to world, shape (4, 4) for a body at rest or (frames, 4, 4).
        reflectance: Lambertian albedo, 0 to 1.
        specular: Share of the light that is mirrored, 0 to 1.
        transmission: Share of the light that each of its surfaces transmits, without refraction, 0 to 1.
        velocity_m_s: Velocity within a frame of a body with a single pose [m/s]; bodies with a pose per frame move
            from each to the next.
        importance: Weight of its surface as a target, above 0; a factor on that of its mesh.
    """

    shape: Shape
    name: str = "body"
    role: Role = "both"
    poses: np.ndarray = field(default_factory=lambda: np.eye(4))
    reflectance: float = 0.5
    specular: float = 0.0
    transmission: float = 0.0
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    importance: float = 1.0

    def __post_init__(self) -> None:
        poses = np.asarray(self.poses, dtype=np.float64)
        if poses.shape[-2:] != (4, 4) or poses.ndim not in (2, 3) or not poses.size or not np.isfinite(poses).all():
            raise DataError(
                f"body {self.name!r}: poses have shape {poses.shape} or are not finite",
                allowed="(4, 4) or (frames, 4, 4)",
            )
        if np.abs(poses[..., :3, 3]).max() > FARTHEST_M:
            raise DataError(
                f"body {self.name!r}: a pose is {np.abs(poses[..., :3, 3]).max():g} m away",
                allowed=f"at most {FARTHEST_M:g} m from the origin",
            )
        rotation = poses[..., :3, :3]
        apart = np.abs(rotation @ np.swapaxes(rotation, -1, -2) - IDENTITY)
        is_rigid = (apart <= RIGID_TOLERANCE).all() and (np.linalg.det(rotation) > 0).all()
        if not is_rigid or (poses[..., 3, :] != (0, 0, 0, 1)).any():
            raise DataError(
                f"body {self.name!r}: a pose is not rigid",
                allowed="a rotation without scale or reflection, a translation, and 0 0 0 1 below",
            )
        if self.role not in ROLES:
            raise DataError(f"body {self.name!r}: unknown role {self.role!r}", allowed=", ".join(ROLES))
        _check_shares(
            f"body {self.name!r}",
            reflectance=self.reflectance,
            specular=self.specular,
            transmission=self.transmission,
        )
        _check_weights(f"body {self.name!r}", np.asarray(self.importance, dtype=np.float64))
        velocity = tuple(map(float, self.velocity_m_s))
        if len(velocity) != 3 or not all(math.isfinite(value) for value in velocity):
            raise DataError(f"body {self.name!r}: velocity_m_s is {self.velocity_m_s}", allowed="three finite numbers")
        if math.hypot(*velocity) >= SPEED_OF_LIGHT_M_S:
            raise DataError(f"body {self.name!r}: velocity_m_s is {self.velocity_m_s}", allowed="slower than light")
        if any(velocity) and poses.ndim == 3:
            raise DataError(
                f"body {self.name!r} has a velocity and poses per frame", allowed="one of them: poses are its motion"
            )
        object.__setattr__(self, "poses", poses)
        object.__setattr__(self, "velocity_m_s", velocity)

    @property
    def is_target(self) -> bool:
        """True if its surface is to be observed."""
        return self.role != "occluder"

    @property
    def is_occluder(self) -> bool:
        """True if it blocks rays in the density."""
        return self.role != "target"

    @property
    def is_resting(self) -> bool:
        """True if it has one pose and no velocity."""
        return self.poses.ndim == 2 and not any(self.velocity_m_s)

    def pose(self, frame: int = 0) -> np.ndarray:
        """Pose (4, 4) at a frame; a body at rest has the same one in all frames."""
        return self.poses if self.poses.ndim == 2 else self.poses[frame]


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene: bodies, optionally moving over frames, and ground truth for the task's score.

    Arguments:
        bodies: At least one, and at least one target.
        name: Name in messages and reports.
        truth: Ground truth for the task's score (never read by designs, densities or estimates).
        frame_rate_hz: Frames per second where bodies move.
        notes: Notes to the user on how the scene was made, one line each.
        medium: Scattering medium; None: clear air.
        ambient: Ambient light; None: darkness.
        receiver: A fixed receiver of the light of all rays; None: every ray is received at its own origin.
        group: Name of the independent draw, such as a mesh that several scenes share; None: this scene alone.

    Example:
        >>> scene = run.scenes("test", seed=0)[0]
        >>> scene.frames, any(body.is_target for body in scene.bodies)
        (1, True)
    """

    bodies: tuple[Body, ...]
    name: str = "scene"
    truth: Mapping[str, Any] = field(default_factory=dict)
    frame_rate_hz: float = 10.0
    notes: tuple[str, ...] = ()
    medium: Medium | None = None
    ambient: Ambient | None = None
    receiver: Receiver | None = None
    group: str | None = None

    def __post_init__(self) -> None:
        if not any(body.is_target for body in self.bodies):
            raise DataError(f"scene {self.name!r} has no target body", hint="give one body the role target or both")
        counts = {len(body.poses) for body in self.bodies if body.poses.ndim == 3}
        if len(counts) > 1:
            raise DataError(f"scene {self.name!r}: bodies have different numbers of frames {sorted(counts)}")
        for name, kind in (("medium", Medium), ("ambient", Ambient), ("receiver", Receiver)):
            if not isinstance(getattr(self, name), kind | None):
                raise DataError(
                    f"scene {self.name!r}: {name} is {getattr(self, name)!r}", allowed=f"{kind.__name__}(...) or None"
                )
        if not isinstance(self.group, str | None):
            raise DataError(f"scene {self.name!r}: group is {self.group!r}", allowed="text or None")
        if not (math.isfinite(self.frame_rate_hz) and self.frame_rate_hz > 0):
            raise DataError(f"scene {self.name!r}: frame_rate_hz is {self.frame_rate_hz}", allowed="finite, above 0")

    @cached_property
    def frames(self) -> int:
        """The number of time frames; 1 for a scene at rest."""
        return max((len(body.poses) for body in self.bodies if body.poses.ndim == 3), default=1)


def group_numbers(scenes: Sequence[Scene]) -> np.ndarray:
    """Index of each scene's group, shape (S,): 0, 1, ... as they first appear."""
    numbers: dict[object, int] = {}
    keys = (number if scene.group is None else scene.group for number, scene in enumerate(scenes))
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)


def rigid(rotation: np.ndarray | None = None, translation_m: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """A 4x4 pose of a 3x3 rotation and a translation."""
    pose = np.eye(4)
    if rotation is not None:
        pose[:3, :3] = rotation
    pose[:3, 3] = translation_m
    return pose


def inverse_rigid(pose: np.ndarray) -> np.ndarray:
    """The inverse of rigid transforms, shape (..., 4, 4)."""
    rotation = np.swapaxes(pose[..., :3, :3], -1, -2)
    inverse = np.zeros_like(pose)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ pose[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse
