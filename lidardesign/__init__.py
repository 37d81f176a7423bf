"""lidardesign: from simulated scenes of a task to physical LiDAR designs that are proven on held-out scenes.

    import lidardesign as ld

    run = ld.learn("face", preset="draft", out="runs/face")     # or ld.open_run("runs/face")
    design = run.fit(sensors=4, constraints={"gate": {"width_m": {"max": 0.1}}}, name="kept")
    design.save()
    print(run.evaluate([design], rays=[196, 361]).rows)

Importing this package loads nothing heavy: every name is imported when it is first used.
"""

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
