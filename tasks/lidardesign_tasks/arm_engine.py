"""MuJoCo and mink, imported only when an arm moves, and MuJoCo's warnings kept off the disk."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from lidardesign.errors import ConfigError


def import_mujoco() -> Any:
    """MuJoCo, the physics engine; raises ConfigError where it is missing."""
    return _imported("mujoco")


def import_mink() -> Any:
    """mink, inverse kinematics for MuJoCo; raises ConfigError where it is missing."""
    return _imported("mink")


def _imported(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"the arm task needs {name}, which cannot be imported ({error})",
            where="task arm",
            hint="pip install mujoco mink",
        ) from error


@contextmanager
def mujoco_warnings() -> Iterator[list[str]]:
    """Collects MuJoCo's warnings, which would otherwise be written to MUJOCO_LOG.TXT in the working folder."""
    mujoco = import_mujoco()
    before, warnings = mujoco.get_mju_user_warning(), []
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        mujoco.set_mju_user_warning(before)
