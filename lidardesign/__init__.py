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
from typing import Any

__version__ = "0.1.0"
_HOMES = {
    "Constraints": "lidardesign.design.constraints.document",
    "Design": "lidardesign.workflow.designs",
    "Rays": "lidardesign.geometry.rays",
    "Run": "lidardesign.workflow.runs",
    "Scene": "lidardesign.scene",
    "Scores": "lidardesign.workflow.evaluate",
    "Task": "lidardesign.task",
    "evaluate_seeds": "lidardesign.workflow.seeds",
    "learn": "lidardesign.workflow.runs",
    "load_design": "lidardesign.workflow.runs",
    "open_run": "lidardesign.workflow.runs",
}
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _is_cache(folder: str) -> bool:
    """Whether numba can keep compiled code in a user's cache folder, which may still have to be made."""
    place = os.path.abspath(os.path.join(folder, "numba"))
    while not os.path.lexists(place):
        place = os.path.dirname(place)
    return not folder.startswith("~") and os.path.isdir(place) and os.access(place, os.W_OK | os.X_OK)


def _make_cache() -> str:
    """Path of a cache folder below the temporary files, the same for all processes of one user.

    Its name is no secret and a cache holds code: what others made, or can open, is not used.
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
