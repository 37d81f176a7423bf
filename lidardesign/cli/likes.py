"""`--like RIG`: fitting sensors that are no more than a rig that there is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    from lidardesign.cli.console import Console
    from lidardesign.cli.runs import Run
    from lidardesign.design.constraints import Constraints

Asked = TypeVar("Asked", "Constraints", None)
# In the others rays are sensors of their own, or leave their sensors' places.
LAYOUTS = ("grid", "density")


def likeness(
    like: Path | None, asked: Asked, layout: str | None, rays: int | None, run: Run, console: Console
) -> tuple[Constraints | Asked, str | None]:
    """The constraints with those of a rig below them, and the layout; both as they are where there is no rig.

    Raises:
        ConfigError: A layout whose rays are no sensor's, or more sensors than a fit takes.
        DataError: The rig cannot be read.
    """
    if like is None:
        return asked, layout
    from lidardesign.cli.rigs import reach_of
    from lidardesign.cli.runs import read_design
    from lidardesign.design.constraints import Constraints
    from lidardesign.design.likeness import constraints_like, taken_over

    layout = layout or LAYOUTS[0]
    if layout not in LAYOUTS:
        raise ConfigError(f"{layout} beside --like", where="--layout", allowed=", ".join(LAYOUTS))
    rig = read_design(like, console, reach_of([run]))
    own = Constraints() if asked is None else asked
    found = constraints_like(rig, run.config.space, own, rays=rays)
    for line in taken_over(rig, found, own):
        console.note(f"note: {line}")
    return found, layout
