"""Bring your own meshes: a folder of mesh files and a design space.

Every file is one object of a class (or one scan). Files are split into training and held-out ones; each is
shown in a few slightly different poses. With a single file the splits differ in poses alone. The world's z
axis is up, and by default the sensor is in front (+x) of the objects, at twice their extent, and looks at
them. With a CSV of poses over time objects and occluders move, and every frame is scored. With clutter
several objects lie in a bin or on a table, and the sensor looks down at them from the same side.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from shlex import quote
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from lidardesign import (
    FARTHEST_M,
    Body,
    ConfigError,
    DataError,
    Defaults,
    DesignSpace,
    FolderConfig,
    Information,
    Mesh,
    Metric,
    Returns,
    Scene,
    Score,
    Sign,
    Split,
    Vector,
    mesh_files,
    random_generator,
    suggest,
)
from lidardesign_tasks.importance import WEIGHING_KEYS, Importance, middle_of_origins
from lidardesign_tasks.motion import Motion, load_motion, moved_bounds_m
from lidardesign_tasks.moving_surface import SURFACES, moving_informs, moving_score, with_moving_truth
from lidardesign_tasks.piles import Background, Kind, background_of, settled_poses
from lidardesign_tasks.poses import jittered_pose
from lidardesign_tasks.surface import (
    METRIC,
    MILLIMETRES,
    surface_informs,
    surface_score,
    with_visible_truth,
)
from lidardesign_tasks.surroundings import any_direction
from lidardesign_tasks.units import doubtful_meshes, doubtful_motion
from lidardesign_tasks.view import OriginBox, space_around, space_around_box

Axis = Literal["format", "x", "y", "z"]
Factor = Annotated[float, Field(gt=0, le=FARTHEST_M, strict=True)]
Scale = Annotated[
    Annotated[Factor, Tag("one")] | Annotated[dict[str, Factor], Tag("several")],
    Discriminator(lambda value: "several" if isinstance(value, dict) else "one"),
]
# the file's axes that become the world's x, y, z: a rotation of the up axis to z
WORLD_AXES = {"x": [1, 2, 0], "y": [2, 0, 1], "z": [0, 1, 2]}
RELATIVE_JITTER = 0.02  # of the largest extent, where no shift is given
SENSOR_DISTANCE = 2.0  # extents
ABOVE_DEG = 45.0  # elevation of the sensor seen from the middle of a pile
TOLERATED_SHARE = 4e-4  # of the longest extent: 0.1 mm of a head of 0.25 m
SPLIT_SEED = 0  # of the choice of held-out meshes, for all seeds of runs
SAME_MESH = "training and held-out scenes show the same one in other poses, so scores say nothing of other objects"
ROOM = 1.1  # around the bounding sphere, for the pose jitter
MOST_NAMED = 6
KNOWN = "known"  # key of the background whose returns are removed before scoring
ALONE = ("motion", "speed_m_s", "jitter_rotation_deg", "jitter_translation_m", "area_exponent")


class MeshesConfig(FolderConfig, Importance):
    """Folder, reading, split, motion and importance of meshes, their surroundings, and bounds of sensors."""

    folders: ClassVar[dict[str, tuple[str, ...]]] = {"folder": mesh_files.SUFFIXES, "occluders": mesh_files.SUFFIXES}

    folder: Path | None = Field(None, description="folder of mesh files (glb, gltf, obj, off, ply, stl)")
    leave_out: tuple[str, ...] = Field((), description="names of files that are not read, or patterns such as *_old.*")
    scale: Scale = Field(
        1.0,
        description="factor from the files' unit to metres (0.001 for mm); or factors by name or pattern, of which the "
        "first that fits counts",
    )
    sign: Sign = Field("auto", description="inside rule: auto, solid, winding or unsigned")
    up: Axis = Field("format", description="the axis of the files that points up; format: y in glb and gltf, else z")
    centre: bool = Field(True, description="move the centre of each mesh's bounds to the origin")
    test_share: float = Field(0.5, gt=0, lt=1, description="share of the files that is held out")
    poses: int = Field(4, ge=1, le=1000, description="scenes per mesh")
    clutter: int = Field(
        0,
        ge=0,
        le=30,
        description="objects per scene that are dropped until they rest; 0: one object alone, not dropped",
    )
    background: Kind = Field("bin", description="bin: they are dropped into one, any way up; table: onto one, upright")
    background_returns: Literal["removed", "stay"] = Field(
        "removed", description="whether returns from the bin or table, whose place is known, are removed before scoring"
    )
    jitter_rotation_deg: float = Field(4.0, ge=0, le=180, description="standard deviation of the pose [deg]")
    jitter_translation_m: float | None = Field(
        None, ge=0, le=FARTHEST_M, description="of the place [m]; 2 % of the extent if empty"
    )
    occluders: Path | None = Field(None, description="folder of meshes that block the view, in world coordinates")
    origin_m: Vector | None = Field(None, description="place of the sensor [m]; if empty: in front, 2 extents away")
    origin_box_m: OriginBox = Field(0.0, description="half size of the box of sensor origins [m]; 0: fixed")
    truth_points: int = Field(
        5000, ge=100, le=200_000, description="points of the visible surface that scores compare with"
    )
    motion: Path | None = Field(
        None,
        description="CSV of poses over time: columns time_s, body, x_m, y_m, z_m, and qw, qx, qy, qz or "
        "roll_deg, pitch_deg, yaw_deg or roll_rad, pitch_rad, yaw_rad",
    )
    frame_rate_hz: float = Field(10.0, gt=0, le=10_000, description="frames per second of a motion [Hz]")
    speed_m_s: float = Field(0.0, ge=0, le=100, description="how fast objects move within a frame, in any direction")
    importance: str | None = Field(
        None, min_length=1, description="vertex property of the files that says how much the surface counts, or colours"
    )
    colour_contrast: float = Field(
        10.0, gt=1e-3, le=1e3, description="how many times as much white counts as black, with importance=colours"
    )

    def reads(self, path: Path) -> bool:
        """True if a file is one of those that are read in the folders, and not left out."""
        return super().reads(path) and _fitting(path.name, self.leave_out) is None

    def factor(self, name: str) -> float:
        """Factor from the unit of a file to metres, 1 where none is given."""
        if isinstance(self.scale, float):
            return self.scale
        pattern = _fitting(name, self.scale)
        return 1.0 if pattern is None else self.scale[pattern]

    def held_out(self, files: Sequence[Path]) -> Sequence[Path]:
        """A share of the meshes, the same for all seeds; none of a single one."""
        files = [file for file in files if file.parent == self.folder]
        order = random_generator(SPLIT_SEED, "meshes", "split").permutation(len(files))
        return [files[i] for i in order[: min(max(round(self.test_share * len(files)), 1), len(files) - 1)]]

    @model_validator(mode="after")
    def _contrast_of_colours(self) -> MeshesConfig:
        if (
            self.importance != mesh_files.COLOURS
            and self.colour_contrast != type(self).model_fields["colour_contrast"].default
        ):
            raise ValueError("colour_contrast needs importance=colours")
        return self

    @model_validator(mode="after")
    def _what_lies_in_a_pile(self) -> MeshesConfig:
        fields = type(self).model_fields
        if not self.clutter and (self.background, self.background_returns) != ("bin", "removed"):
            raise ValueError("background is for a pile: set clutter=N too")
        alone = [key for key in ALONE if self.clutter and getattr(self, key) != fields[key].default]
        if alone:
            raise ValueError(f"{alone[0]} is for a single object: remove it or clutter")
        return self

    @model_validator(mode="after")
    def _one_way_to_move(self) -> MeshesConfig:
        if self.motion is not None and self.speed_m_s:
            raise ValueError("speed_m_s is for objects without a motion: remove it or motion")
        if self.motion is None and self.frame_rate_hz != type(self).model_fields["frame_rate_hz"].default:
            raise ValueError("frame_rate_hz is for a motion: set motion=FILE.csv too")
        return self


def _fitting(name: str, patterns: Iterable[str]) -> str | None:
    """The first of some names of files, or patterns, that fits a name."""
    return next((pattern for pattern in patterns if name == pattern or fnmatchcase(name, pattern)), None)


class MeshesTask:
    """Reconstruct the surface of your objects from few rays."""

    name: ClassVar[str] = "meshes"
    summary: ClassVar[str] = "your own folder of meshes, with a design space in YAML or one derived from their size"
    api_version: ClassVar[int] = 1
    weighing_keys: ClassVar[tuple[str, ...]] = (*WEIGHING_KEYS, "importance", "colour_contrast")
    Config: ClassVar[type[MeshesConfig]] = MeshesConfig
    # of meshes of a metre; `metric_of` has those of a configuration
    metric: ClassVar[Metric] = Metric(
        "Chamfer distance", "mm", "lower", worst=MILLIMETRES, tolerance=MILLIMETRES * TOLERATED_SHARE
    )
    defaults: ClassVar[Defaults] = Defaults(rays=(36, 100, 196, 361, 576), density={"sigma_m": 0.005})

    def space(self, config: MeshesConfig) -> DesignSpace:
        """Design space of a sensor in front of all meshes that covers every one of them."""
        meshes = load_folder(config)
        return derived_space(config, meshes, motion_of(config, meshes))

    def scenes(
        self, config: MeshesConfig, split: Split, seed: int, space: DesignSpace | None = None
    ) -> Sequence[Scene]:
        """Each mesh of the split, a group, in `poses` poses; the occluders are in every scene.

        In a pile it is among others of its split, and the group of a scene is the set of its meshes.

        Raises:
            DataError: The folder or a file in it cannot be used, no ray can reach a mesh, or piles do not come to rest.
            ConfigError: No folder is set, or one mesh without pose jitter would make both splits the same.
        """
        meshes = load_folder(config)
        motion = motion_of(config, meshes)
        space = space or derived_space(config, meshes, motion)
        shift, metric = jitter_m(config, [mesh for _, mesh in meshes]), self.metric_of(config)
        if len(meshes) == 1 and not config.clutter and config.jitter_rotation_deg == 0 and shift == 0:
            raise ConfigError(
                "one mesh without pose jitter makes training and held-out scenes the same",
                where="task.jitter_rotation_deg",
                hint="add meshes, or set jitter_rotation_deg or jitter_translation_m above 0",
            )
        config.refuse_empty_region([mesh.vertices for _, mesh in meshes])
        chosen = split_meshes(meshes, config, split)
        counting = {name: weighted(mesh, config, space) for name, mesh in chosen}
        around = tuple(_occluder(name, mesh, motion) for name, mesh in load_occluders(config))
        background = pile_of(config, meshes)
        further = {METRIC: metric}
        if background is not None:
            around = (*background.bodies(), *around)
            further |= {KNOWN: background} if config.background_returns == "removed" else {}
        scenes = []
        for (name, mesh), pose in itertools.product(chosen, range(config.poses)):
            generator = random_generator(seed, "meshes", split, name, pose)
            title, velocity = f"{split} {name} pose {pose}", None
            if background is not None:
                placed, group = _pile(name, chosen, counting, background, generator)
            else:
                jitter = jittered_pose(generator, config.jitter_rotation_deg, shift, mesh.bounds_m.mean(axis=0))
                path = None if motion is None else motion.of_object(name)
                placed, group = (Body(counting[name], name, "both", jitter if path is None else path @ jitter),), name
                velocity = random_generator(seed, "meshes", split, name, pose, "velocity")
            scene = Scene((*placed, *around), title, frame_rate_hz=config.frame_rate_hz, group=group)
            judge = with_visible_truth if motion is None else with_moving_truth
            judged = judge(scene, space, config.truth_points, generator, **further)
            if config.speed_m_s:
                moves = replace(placed[0], velocity_m_s=config.speed_m_s * any_direction(velocity))
                judged = replace(judged, bodies=(moves, *around))
            scenes.append(config.around(judged))
        return scenes

    def metric_of(self, config: MeshesConfig) -> Metric:
        """Metric with the longest extent of any mesh as the worst value, and a share of it as the tolerance.

        The worst value of a pile is its own longest extent.
        """
        meshes = load_folder(config)
        longest_mm = MILLIMETRES * max(extent_m([mesh]) for _, mesh in meshes)
        background = pile_of(config, meshes)
        worst_mm = longest_mm if background is None else MILLIMETRES * float(np.ptp(background.bounds_m, axis=0).max())
        return replace(self.metric, worst=worst_mm, tolerance=TOLERATED_SHARE * longest_mm)

    def notes(self, config: MeshesConfig, space: DesignSpace) -> list[str]:
        """Notes on the meshes, the split, the sensors' origins, and lengths that may be in another unit."""
        meshes = load_folder(config)
        extents_m = {name: extent_m([mesh]) for name, mesh in meshes}
        around_m = {name: extent_m([mesh]) for name, mesh in load_occluders(config)}
        motion = motion_of(config, meshes)
        bounds_m = {} if motion is None else {
            name: moved_bounds_m(mesh, motion.of_object(name)) for name, mesh in meshes
        }  # fmt: skip
        return [
            *_what_was_read(config, meshes, space),
            *_what_was_not_read(config),
            *doubtful_meshes(extents_m, config.scale, around_m),
            *doubtful_motion(bounds_m, extent_m([mesh for _, mesh in meshes]), space),
            *(f"{name} is the only mesh: {SAME_MESH}" for name, _ in meshes if len(meshes) == 1),
        ]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Chamfer distance [mm] between the reconstruction and the part of the surface that could be seen."""
        score = moving_score if SURFACES in scene.truth else surface_score
        return score(scene.truth.get(METRIC, self.metric), scene, _without_known(scene, returns))

    def informs(self, scene: Scene, returns: Sequence[Returns], share: float) -> Information:
        """Information of returns about points of the visible surface in each frame, larger for nearer points."""
        informs = moving_informs if SURFACES in scene.truth else surface_informs
        return informs(scene, _without_known(scene, returns), share)


def _without_known(scene: Scene, returns: Sequence[Returns]) -> Sequence[Returns]:
    """The returns without those on a known background that is to be removed."""
    background = scene.truth.get(KNOWN)
    return returns if background is None else [background.removed(frame) for frame in returns]


def pile_of(config: MeshesConfig, meshes: Sequence[tuple[str, Mesh]]) -> Background | None:
    """The bin or table of a pile; None for single objects."""
    if not config.clutter:
        return None
    return background_of(config.background, [mesh for _, mesh in meshes], config.clutter)


def _pile(
    name: str,
    chosen: Sequence[tuple[str, Mesh]],
    counting: Mapping[str, Mesh],
    background: Background,
    generator: np.random.Generator,
) -> tuple[tuple[Body, ...], str]:
    """A mesh in a pile with others of its split, drawn equally often, and the names of all as the group."""
    rounds = -(-background.objects // len(chosen))
    drawn = np.concatenate([generator.permutation(len(chosen)) for _ in range(rounds)])[: background.objects]
    first = [index for index, (other, _) in enumerate(chosen) if other == name]
    if first[0] not in drawn:
        drawn[0] = first[0]
    meshes = [chosen[index] for index in np.sort(drawn)]
    poses = settled_poses(tuple(mesh for _, mesh in meshes), background, int(generator.integers(2**62)))
    numbered = enumerate(zip(meshes, poses, strict=True), start=1)
    bodies = tuple(Body(counting[own], f"{own} {number}", "both", pose) for number, ((own, _), pose) in numbered)
    return bodies, ", ".join(sorted({own for own, _ in meshes}))


def _what_was_read(config: MeshesConfig, meshes: Sequence[tuple[str, Mesh]], space: DesignSpace) -> list[str]:
    """Notes on number, size and split of the meshes, on the pile, and on the sensors' origins."""
    lengths_m = sorted(extent_m([mesh]) for _, mesh in meshes)
    sizes = " to ".join(dict.fromkeys(f"{length_m:.3g}" for length_m in (lengths_m[0], lengths_m[-1])))
    held_out = [name for name, _ in split_meshes(meshes, config, "test")]
    low, high = space.low[:3], space.high[:3]
    places = (f"{a:.3g}" if a == b else f"{a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True))
    count = "1 mesh" if len(meshes) == 1 else f"{len(meshes)} meshes"
    lines = [f"{count} of {sizes} m; held out: {_named(held_out)}"]
    background = pile_of(config, meshes)
    if background is not None:
        wide, objects = 2 * background.half_m, "1 object" if config.clutter == 1 else f"{config.clutter} objects"
        lines.append(
            f"{objects} per scene, dropped {'into a bin' if config.background == 'bin' else 'onto a table'} of "
            f"{wide:.3g} by {wide:.3g} m around x = y = 0 at z = 0; in contact each is its convex hull"
        )
    named_places = (f"{axis} = {place}" for axis, place in zip("xyz", places, strict=True))
    return [*lines, f"sensors at {', '.join(named_places)} m"]


def _what_was_not_read(config: MeshesConfig) -> list[str]:
    """Notes on files in the folders that are left out, on those of other formats, and on folders of meshes in them."""
    folders = [folder for folder in (config.folder, config.occluders) if folder is not None]
    entries = [path for folder in folders for path in sorted(folder.iterdir()) if path.name[0] != "."]
    left_out = [path.name for path in entries if _fitting(path.name, config.leave_out) is not None]
    others: dict[tuple[str, str | None], list[str]] = {}
    for path in entries:
        suffix = path.suffix.lower()
        if (
            path.is_dir()
            and path != config.occluders
            and any(one.suffix.lower() in mesh_files.SUFFIXES for one in path.glob("*"))
        ):
            others.setdefault(("a folder of meshes inside the folder", "move them out of it"), []).append(path.name)
        elif suffix in mesh_files.OTHER_FORMATS and suffix not in mesh_files.TABLES and path.name not in left_out:
            others.setdefault(mesh_files.OTHER_FORMATS[suffix], []).append(path.name)
    return [
        *([f"left out: {', '.join(left_out)}"] if left_out else []),
        *(
            f"not read: {_named(names)} ({found.removeprefix('is ')}): {hint}"
            for (found, hint), names in others.items()
        ),
    ]


def _named(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if names[MOST_NAMED:] else "")


def load_folder(config: MeshesConfig) -> list[tuple[str, Mesh]]:
    """Name and mesh of every file, in metres, z up, centred by default."""
    if config.folder is None:
        raise ConfigError("no folder of meshes is set", where="task.folder", hint="--set folder=PATH")
    _check_names(config)
    painted = None if config.importance is None else mesh_files.Painted(config.importance, config.colour_contrast)
    return _load(str(config.folder), config, config.sign, config.centre, painted)


def load_occluders(config: MeshesConfig) -> list[tuple[str, Mesh]]:
    """Name and mesh of every occluder, in metres, z up, in the files' coordinates."""
    return _load(str(config.occluders), config, "auto", False) if config.occluders is not None else []


def motion_of(config: MeshesConfig, meshes: Sequence[tuple[str, Mesh]]) -> Motion | None:
    """Motion of a configuration in frames; None without one."""
    if config.motion is None:
        return None
    others = [name for name, _ in load_occluders(config)]
    return load_motion(config.motion, config.frame_rate_hz, [name for name, _ in meshes], others)


def _occluder(name: str, mesh: Mesh, motion: Motion | None) -> Body:
    """An occluder in its file's coordinates, or with its own poses."""
    path = None if motion is None else motion.of(name)
    return Body(mesh, name, "occluder") if path is None else Body(mesh, name, "occluder", path)


def weighted(mesh: Mesh, config: MeshesConfig, space: DesignSpace) -> Mesh:
    """A mesh with the importance of the configuration times that of its file."""
    weights = config.weights(mesh.vertices, mesh.faces, middle_of_origins(space))
    if weights is None:
        return mesh
    return replace(mesh, importance=weights if mesh.importance is None else weights * mesh.importance)


def _load(
    folder: str, config: MeshesConfig, sign: Sign, centre: bool, painted: mesh_files.Painted | None = None
) -> list[tuple[str, Mesh]]:
    meshes, errors = [], {}
    for name, path in config.learned_files(_mesh_files(folder, config)).items():
        if path is not None:
            state, factor = path.stat() if path.exists() else path.lstat(), config.factor(name)
            try:
                mesh = _load_file(path, state.st_mtime_ns, state.st_size, sign, factor, config.up, centre, painted)
            except DataError as error:
                errors[name] = error
            else:
                meshes.append((name, mesh))
    if errors:
        raise _unusable(folder, errors, len(meshes), config)
    return meshes


def _unusable(folder: str, errors: Mapping[str, DataError], usable: int, config: MeshesConfig) -> DataError:
    """The error of files that cannot be used, with how to go on without them where there are others."""
    first = next(iter(errors.values()))
    names = json.dumps([*config.leave_out, *errors], ensure_ascii=False)
    without = f"leave out what cannot be used: --set {quote(f'leave_out={names}')}"
    # what a run was learned from stays
    hint = "; or ".join(filter(None, (first.hint, without if usable and not config.inputs else None))) or None
    if len(errors) == 1:
        return DataError(first.message, where=first.where, allowed=first.allowed, hint=hint)
    found = "; ".join(f"{Path(error.where or name).name}: {error.message}" for name, error in errors.items())
    count = f"{len(errors)} of {len(errors) + usable} meshes cannot be used"
    return DataError(f"{count}: {found}", where=folder, allowed=first.allowed, hint=hint)


def _mesh_files(folder: str | Path, config: MeshesConfig) -> list[Path]:
    """Paths of the mesh files inside a folder that are not left out, sorted by name."""
    files = [path for path in mesh_files.list_mesh_files(folder) if config.reads(path)]
    if not files:
        raise ConfigError(f"leaves out every mesh of {folder}", where="task.leave_out", allowed="some of them")
    return files


def _check_names(config: MeshesConfig) -> None:
    """Refuse names and patterns of files, in keys, that fit no file of the folders."""
    folders = [Path(str(folder)) for folder in (config.folder, config.occluders) if folder is not None]
    names = {path.name for folder in folders if folder.is_dir() for path in folder.iterdir()}
    names |= {Path(path).name for path in config.inputs}
    for key, patterns in {"leave_out": config.leave_out, "scale": config.scale}.items():
        for pattern in () if isinstance(patterns, float) else patterns:
            if not any(_fitting(name, [pattern]) for name in names):
                meant = suggest(pattern, names)
                raise ConfigError(f"{pattern!r} fits no file in the folder", where=f"task.{key}", hint=meant)


@lru_cache(maxsize=256)
def _load_file(
    path: Path,
    changed_ns: int,
    size: int,
    sign: Sign,
    scale: float,
    up: Axis,
    centre: bool,
    painted: mesh_files.Painted | None,
) -> Mesh:
    """Read a file, once per process while it is unchanged, as space and both splits need it."""
    mesh = mesh_files.load_mesh(path, sign=sign, scale=scale, painted=painted)
    if up == "format":
        up = "y" if path.suffix.lower() in mesh_files.Y_UP else "z"
    vertices = mesh.vertices[:, WORLD_AXES[up]]
    if centre:
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return replace(mesh, vertices=vertices, notes=tuple(f"{path.name}: {note}" for note in mesh.notes))


def split_meshes(meshes: Sequence[tuple[str, Mesh]], config: MeshesConfig, split: Split) -> list[tuple[str, Mesh]]:
    """Meshes of a split, each in exactly one; a single mesh is in both, in other poses.

    The seed changes poses alone: held-out meshes are the same for all seeds. They also stay the same where files were
    added or removed since a run was learned, as the run's own files, also missing ones, are split.

    Raises:
        DataError: No mesh of the split is left.
    """
    names = list(config.learned_files(_mesh_files(config.folder, config)))
    if len(names) == 1:
        return list(meshes)
    held_out = {path.name for path in config.held_out([config.folder / name for name in names])}
    kept = [(name, mesh) for name, mesh in meshes if (name in held_out) == (split == "test")]
    if not kept:
        which, hint = "held-out" if split == "test" else "training", "put them back, or learn again"
        raise DataError(f"holds none of the {which} meshes of the run", where=str(config.folder), hint=hint)
    return kept


def extent_m(meshes: Sequence[Mesh]) -> float:
    """Longest side of the bounding box of all meshes [m]."""
    low, high = _bounds([mesh.bounds_m for mesh in meshes])
    return float((high - low).max())


def jitter_m(config: MeshesConfig, meshes: Sequence[Mesh]) -> float:
    """Standard deviation of the shift along each axis [m]."""
    given = config.jitter_translation_m
    return RELATIVE_JITTER * extent_m(meshes) if given is None else given


def _bounds(boxes: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    corners = np.concatenate(boxes)
    return corners.min(axis=0), corners.max(axis=0)


def derived_space(config: MeshesConfig, named: Sequence[tuple[str, Mesh]], motion: Motion | None = None) -> DesignSpace:
    """Design space with all directions and ranges to the sphere around all meshes in all poses, from every origin.

    For a pile it is the box around it instead of the sphere.
    """
    half = np.broadcast_to(np.asarray(config.origin_box_m, dtype=np.float64), 3)
    background = pile_of(config, named)
    if background is not None:
        bounds_m, up = background.bounds_m, math.radians(ABOVE_DEG)
        away_m = SENSOR_DISTANCE * float(np.ptp(bounds_m, axis=0).max())
        above = bounds_m.mean(axis=0) + away_m * np.array([math.cos(up), 0.0, math.sin(up)])
        return space_around_box(bounds_m, above if config.origin_m is None else np.array(config.origin_m), half)
    meshes = [mesh for _, mesh in named]
    low, high = _bounds(
        [moved_bounds_m(mesh, None if motion is None else motion.of_object(name)) for name, mesh in named]
    )
    centre = (low + high) / 2
    radius = ROOM * (float(np.linalg.norm(high - low)) / 2 + 2 * jitter_m(config, meshes))
    ahead = centre + np.array([max(SENSOR_DISTANCE * extent_m(meshes), 2 * radius), 0.0, 0.0])
    origin = ahead if config.origin_m is None else np.array(config.origin_m)
    return space_around(centre, radius, origin, half)
