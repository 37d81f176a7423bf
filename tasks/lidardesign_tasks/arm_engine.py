"""mink, inverse kinematics for MuJoCo, imported only when an arm moves."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from lidardesign.errors import ConfigError


def import_mink() -> Any:
    """mink; raises ConfigError where it is missing."""
    try:
        return import_module("mink")
    except ImportError as error:
        raise ConfigError(
            f"the arm task needs mink, which cannot be imported ({error})",
            where="task arm",
            hint="pip install mujoco mink",
        ) from error
