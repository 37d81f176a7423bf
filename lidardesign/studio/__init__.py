"""The studio: a page on this machine on which sensors are moved, fitted and scored."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidardesign.choices.files import StudioChoices
from lidardesign.choices.flag import complete, takes
from lidardesign.errors import ConfigError

if TYPE_CHECKING:
    from typing import Unpack

    from lidardesign.api.design import Design
    from lidardesign.api.run import Run
    from lidardesign.studio.studio import Studio


@takes(StudioChoices)
def open_page(run: Run, design: Design | None = None, **choices: Unpack[StudioChoices]) -> Studio:
    """Open a page on this machine on which sensors are moved, fitted and scored; in a notebook it is shown inside.

    Arguments:
        run: The run whose designs are moved.
        design: The design to begin with; the last that is saved by default.
        choices: Those of `StudioChoices`.

    Returns:
        The page: its `address`, `wait()` and `stop()`.

    Raises:
        ConfigError: viser is not installed, or the port is taken.
    """
    port = complete(StudioChoices, choices)["port"]
    try:
        from lidardesign.studio.studio import Studio
    except ImportError as error:
        hint = "pip install 'lidardesign[studio]'"
        raise ConfigError(f"the studio needs {error.name}", where="studio", hint=hint) from None
    return Studio(run, design, port)
