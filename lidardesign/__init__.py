"""lidardesign: from simulated scenes of a task to physical LiDAR designs that are proven on held-out scenes.

    import lidardesign as ld

    run = ld.learn("face", preset="draft", out="runs/face")     # or ld.open_run("runs/face")
    design = run.fit(sensors=4, constraints={"gate": {"width_m": {"max": 0.1}}}, name="kept")
    design.save()
    print(run.evaluate([design], rays=[196, 361]).rows)

Importing this package loads nothing heavy: every name is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidardesign.design.constraints.document import Constraints
    from lidardesign.geometry.rays import Rays, Returns
    from lidardesign.scene import (
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
    from lidardesign.workflow.designs import Design
    from lidardesign.workflow.evaluate import Scores
    from lidardesign.workflow.runs import Run, learn, load_design, open_run
    from lidardesign.workflow.seeds import evaluate_seeds

__version__ = "0.1.0"
__all__ = [
    "Ambient", "Body", "Box", "Capsule", "Constraints", "Cylinder", "Defaults", "Design", "DesignSpace", "Ellipsoid",
    "Information", "Medium", "Mesh", "Metric", "Plane", "Rays", "Receiver", "Returns", "Run", "Scene", "Score",
    "Scores", "Sphere", "Split", "Task", "TaskConfig", "__version__", "evaluate_seeds", "learn", "load_design",
    "open_run", "random_generator", "rigid",
]  # fmt: skip
# Where names are imported from when they are first used; type checkers read the imports above.
_HOMES = {
    "lidardesign.design.constraints.document": "Constraints",
    "lidardesign.geometry.rays": "Rays Returns",
    "lidardesign.scene": "Ambient Body Box Capsule Cylinder Ellipsoid Medium Mesh Plane Receiver Scene Sphere rigid",
    "lidardesign.space": "DesignSpace",
    "lidardesign.task": "Defaults Information Metric Score Split Task TaskConfig random_generator",
    "lidardesign.workflow.designs": "Design",
    "lidardesign.workflow.evaluate": "Scores",
    "lidardesign.workflow.runs": "Run learn load_design open_run",
    "lidardesign.workflow.seeds": "evaluate_seeds",
}


def _import(name: str) -> Any:
    home = next((home for home, names in _HOMES.items() if name in names.split()), None)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(home), name)
    return value


if not TYPE_CHECKING:
    # to a type checker any name would be there
    __getattr__ = _import


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
