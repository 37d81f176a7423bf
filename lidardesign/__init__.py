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
    from lidardesign.formats import Format
    from lidardesign.formats.rig import Rig, RigSensor
    from lidardesign.problem.problem import DesignResult, ray_design
    from lidardesign.scenes.rays import Rays, Returns
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
        Sphere,
        rigid,
    )
    from lidardesign.space import DesignSpace
    from lidardesign.task import Defaults, Information, Metric, Score, Split, Task, TaskConfig, random_generator

__version__ = "0.1.0"
__all__ = [
    "Ambient", "Body", "Box", "Capsule", "Constraints", "Cylinder", "Defaults", "Design", "DesignResult", "DesignSpace",
    "Ellipsoid", "Format", "Information", "Medium", "Mesh", "Metric", "Plane", "Rays", "Receiver", "Returns", "Rig",
    "RigSensor", "Run", "Scene", "Score", "Scores", "Sphere", "Split", "Task", "TaskConfig", "__version__",
    "evaluate_seeds", "learn", "load_design", "open_run", "random_generator", "ray_design", "rigid",
]  # fmt: skip
# Where names are imported from when they are first used; type checkers read the imports above.
_HOMES = {
    "lidardesign.constraints.document": "Constraints",
    "lidardesign.formats": "Format",
    "lidardesign.formats.rig": "Rig RigSensor",
    "lidardesign.problem.problem": "DesignResult ray_design",
    "lidardesign.scenes.rays": "Rays Returns",
    "lidardesign.scenes.scene": (
        "Ambient Body Box Capsule Cylinder Ellipsoid Medium Mesh Plane Receiver Scene Sphere rigid"
    ),
    "lidardesign.space": "DesignSpace",
    "lidardesign.task": "Defaults Information Metric Score Split Task TaskConfig random_generator",
    "lidardesign.api.design": "Design",
    "lidardesign.api.scores": "Scores",
    "lidardesign.api.run": "Run learn load_design open_run",
    "lidardesign.api.seeds": "evaluate_seeds",
}


def _import(name: str) -> Any:
    home = next((home for home, names in _HOMES.items() if name in names.split()), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(home), name)
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
