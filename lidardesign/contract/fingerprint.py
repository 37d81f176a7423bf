"""A digest of what a value holds, whatever the process: what is equal in content has the same one."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel

from lidardesign.scenes.scene import Body, Scene

DEEPEST = 40
# What of scenes and bodies no ray meets, or what is told apart otherwise.
UNSEEN = ("name", "group", "notes", "truth", "bodies", "poses", "importance")


def fingerprint(value: Any) -> str:
    """SHA-256 of the content of dataclasses, arrays, models, mappings, sequences and plain values, in hexadecimal.

    Objects of other kinds count by their type and attributes; cached properties of dataclasses do not count.
    """
    digest = hashlib.sha256()
    _add(digest, value, DEEPEST)
    return digest.hexdigest()


def geometry_fingerprint(scene: Scene) -> str:
    """The same of what rays meet in a scene and what light does there, whatever it and its bodies are called."""
    return fingerprint([*((np.round(body.poses, 12), *_others(body)) for body in scene.bodies), *_others(scene)])


def _others(of: Body | Scene) -> list[Any]:
    return [getattr(of, field.name) for field in fields(of) if field.name not in UNSEEN]


def _add(digest: Any, value: Any, depth: int) -> None:
    if depth == 0:
        raise ValueError("values are nested too deeply, or hold themselves")
    digest.update(f"<{type(value).__qualname__}>".encode())
    if isinstance(value, np.ndarray) and value.dtype != object:
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif value is None or isinstance(value, str | bytes | int | float | complex | np.generic | PurePath | Enum):
        digest.update(repr(value).encode())
    else:
        for part in _parts(value):
            _add(digest, part, depth - 1)
    digest.update(b"</>")


def _parts(value: Any) -> list[Any]:
    """What a value is made of, in an order that does not depend on the process."""
    if is_dataclass(value) and not isinstance(value, type):
        return [(field.name, getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, BaseModel):
        return list(value)
    if isinstance(value, Mapping):
        return sorted(value.items(), key=lambda item: repr(item[0]))
    if isinstance(value, list | tuple | np.ndarray):
        return list(value)
    if isinstance(value, Set):
        return sorted(fingerprint(item) for item in value)
    if isinstance(value, type) or callable(value):
        return [getattr(value, "__module__", ""), getattr(value, "__qualname__", "")]
    return sorted(vars(value).items()) if hasattr(value, "__dict__") else [repr(type(value))]
