"""`--like RIG`: fitting sensors that are no more than a rig that there is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    from lidardesign.cli.output import Output
    from lidardesign.design.constraints.document import Constraints
    from lidardesign.space import DesignSpace
    from lidardesign.workflow.runs import Run

Asked = TypeVar("Asked", "Constraints", None)
# In the others rays are sensors of their own, or leave their sensors' places.
LAYOUTS = ("grid", "density")
# Keys by which tasks are told where sensors may be.
PLACE_KEYS = ("origin_m", "origin_box_m")


def likeness(
    like: Path | None, asked: Asked, layout: str | None, rays: int | None, run: Run, console: Output
) -> tuple[Constraints | Asked, str | None, tuple[str, ...]]:
    """The constraints with those of a rig below them, the layout, and its sensors' names; as they are without a rig.

    Raises:
        ConfigError: A layout whose rays are no sensor's, or more sensors than a fit takes.
        DataError: The rig cannot be read.
        InfeasibleError: It stands where the run's sensors may not.
    """
    if like is None:
        return _settled(asked, run.config.space, console), layout, ()
    from lidardesign.design.constraints.document import Constraints
    from lidardesign.design.constraints.rig_constraints import moved_notes, rig_constraints, rig_notes
    from lidardesign.workflow.runs import reach_of, read_design

    layout = layout or LAYOUTS[0]
    if layout not in LAYOUTS:
        raise ConfigError(f"{layout} beside --like", where="--layout", allowed=", ".join(LAYOUTS))
    rig = read_design(like, console, reach_of([run]))
    own = Constraints() if asked is None else asked
    space = run.config.space
    found = rig_constraints(rig, space, own, rays=rays, hint=_hint(run))
    for line in (*rig_notes(rig, found, own), *moved_notes(rig, space, found)):
        console.note(f"note: {line}")
    return _settled(found, space, console), layout, tuple(sensor.name for sensor in rig.sensors)


def _hint(run: Run) -> str:
    """How a run is learned whose sensors stand where a rig's do, by the keys that its task has."""
    keys = [key for key in PLACE_KEYS if key in type(run.config.task).model_fields]
    others = "the keys x_m, y_m and z_m of its space"
    return f"learn with {' / '.join(keys) or others} for the rig's places: lidardesign tasks show {run.task.name}"


def _settled(constraints: Asked, space: DesignSpace, console: Output) -> Asked:
    """The constraints with pinned origins where the space fixes them; says which were moved there."""
    from lidardesign.design.constraints.origins import snap_to_space

    if constraints is None:
        return constraints
    found, notes = snap_to_space(constraints, space)
    for note in notes:
        console.note(f"note: {note}")
    return found
