"""lidardesign: from simulated scenes of a task to physical LiDAR designs that are proven on held-out scenes.

    import lidardesign as ld

    run = ld.learn("face", preset="draft", out="runs/face")     # or ld.open_run("runs/face")
    design = run.fit(sensors=4, constraints={"gate": {"width_m": {"max": 0.1}}}, name="kept")
    design.save()
    print(run.evaluate([design], rays=[196, 361]).rows)

Importing this package loads nothing heavy: every name is imported when it is first used.
"""

import contextlib
import os
import stat
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidardesign.api.design import Design
    from lidardesign.api.run import Run, learn, load_design, open_run
    from lidardesign.api.scores import Scores
    from lidardesign.api.seeds import evaluate_seeds
    from lidardesign.constraints.document import Constraints
    from lidardesign.errors import BackgroundNote, ConfigError, DataError
    from lidardesign.formats import Format
    from lidardesign.formats.rig import Rig, RigSensor
    from lidardesign.numerics import circular_difference
    from lidardesign.problem.problem import DesignResult, ray_design
    from lidardesign.rays.information import scattered_area_m2, surface_information
    from lidardesign.run import inputs
    from lidardesign.run.arrays import csv_rows, read_npz
    from lidardesign.run.validation import suggest
    from lidardesign.run.yaml import plain_number
    from lidardesign.scenes import mesh_files, mujoco_models
    from lidardesign.scenes.casting import SceneCaster
    from lidardesign.scenes.rays import Outcome, Rays, Returns, rotation_of_quaternion, rotation_of_rpy
    from lidardesign.scenes.scene import (
        Ambient,
        Body,
        Box,
        Capsule,
        Cylinder,
        Ellipsoid,
        Medium,
        Mesh,
        Plane,
        Receiver,
        Scene,
        Shape,
        Sign,
        Sphere,
        inverse_rigid,
        rigid,
    )
    from lidardesign.scenes.surface import half_extents_m, sample_body, sample_triangles
    from lidardesign.scoring import metrics
    from lidardesign.space import AZIMUTH, DIMENSIONS, ELEVATION, FARTHEST_M, RANGE, DesignSpace, aim
    from lidardesign.task import (
        Defaults,
        FolderConfig,
        Information,
        Interval,
        Metres,
        Metric,
        Score,
        Split,
        Task,
        TaskConfig,
        Vector,
        random_generator,
    )

__version__ = "0.1.0"
__all__ = [
    "AZIMUTH", "DIMENSIONS", "ELEVATION", "FARTHEST_M", "RANGE", "Ambient", "BackgroundNote", "Body", "Box", "Capsule",
    "ConfigError", "Constraints", "Cylinder", "DataError", "Defaults", "Design", "DesignResult", "DesignSpace",
    "Ellipsoid", "FolderConfig", "Format", "Information", "Interval", "Medium", "Mesh", "Metres", "Metric", "Outcome",
    "Plane", "Rays", "Receiver", "Returns", "Rig", "RigSensor", "Run", "Scene", "SceneCaster", "Score", "Scores",
    "Shape", "Sign", "Sphere", "Split", "Task", "TaskConfig", "Vector", "__version__", "aim", "circular_difference",
    "csv_rows", "evaluate_seeds", "half_extents_m", "inputs", "inverse_rigid", "learn", "load_design", "mesh_files",
    "metrics", "mujoco_models", "open_run", "plain_number", "random_generator", "ray_design", "read_npz", "rigid",
    "rotation_of_quaternion", "rotation_of_rpy", "sample_body", "sample_triangles", "scattered_area_m2", "suggest",
    "surface_information",
]  # fmt: skip
# Where names are imported from when they are first used, also that of a module; type checkers read the imports above.
_HOMES = {
    "lidardesign.constraints.document": "Constraints",
    "lidardesign.errors": "BackgroundNote ConfigError DataError",
    "lidardesign.formats": "Format",
    "lidardesign.formats.rig": "Rig RigSensor",
    "lidardesign.numerics": "circular_difference",
    "lidardesign.problem.problem": "DesignResult ray_design",
    "lidardesign.rays.information": "scattered_area_m2 surface_information",
    "lidardesign.run.arrays": "csv_rows read_npz",
    "lidardesign.run.inputs": "inputs",
    "lidardesign.run.validation": "suggest",
    "lidardesign.run.yaml": "plain_number",
    "lidardesign.scenes.casting": "SceneCaster",
    "lidardesign.scenes.mesh_files": "mesh_files",
    "lidardesign.scenes.mujoco_models": "mujoco_models",
    "lidardesign.scenes.rays": "Outcome Rays Returns rotation_of_quaternion rotation_of_rpy",
    "lidardesign.scenes.scene": (
        "Ambient Body Box Capsule Cylinder Ellipsoid Medium Mesh Plane Receiver Scene Shape Sign Sphere inverse_rigid"
        " rigid"
    ),
    "lidardesign.scenes.surface": "half_extents_m sample_body sample_triangles",
    "lidardesign.scoring.metrics": "metrics",
    "lidardesign.space": "AZIMUTH DIMENSIONS ELEVATION FARTHEST_M RANGE DesignSpace aim",
    "lidardesign.task": (
        "Defaults FolderConfig Information Interval Metres Metric Score Split Task TaskConfig Vector random_generator"
    ),
    "lidardesign.api.design": "Design",
    "lidardesign.api.scores": "Scores",
    "lidardesign.api.run": "Run learn load_design open_run",
    "lidardesign.api.seeds": "evaluate_seeds",
}


def _import(name: str) -> Any:
    home = next((home for home, names in _HOMES.items() if name in names.split()), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(home)
    globals()[name] = value = module if home.endswith(f".{name}") else getattr(module, name)
    return value


if not TYPE_CHECKING:
    # a type checker would accept any name
    __getattr__ = _import


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _is_cache(folder: str) -> bool:
    """True for a user's cache folder, made or not, in which numba can keep compiled code."""
    place = os.path.abspath(os.path.join(folder, "numba"))
    while not os.path.lexists(place):
        place = os.path.dirname(place)
    return not folder.startswith("~") and os.path.isdir(place) and os.access(place, os.W_OK | os.X_OK)


def _make_cache() -> str:
    """Path of a cache folder below the temporary files, the same for all processes of one user.

    Its name is no secret and a cache holds code: a folder that others made, or can open, is not used.
    """
    import tempfile

    folder = os.path.join(tempfile.gettempdir(), f"lidardesign-{os.getuid()}")
    with contextlib.suppress(FileExistsError):
        os.mkdir(folder, 0o700)
    found = os.lstat(folder)
    own = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077
    return folder if own else tempfile.mkdtemp(prefix="lidardesign-")


# numba refuses to import where neither the package's folder nor the user's cache can be written
if not _is_cache(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")):
    with contextlib.suppress(OSError):
        os.environ["XDG_CACHE_HOME"] = _make_cache()
