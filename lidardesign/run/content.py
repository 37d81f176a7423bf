"""Digests that are equal for equal content in any process."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel


def fingerprint(value: Any) -> str:
    """SHA-256 of the content of dataclasses, arrays, models, mappings, sequences and plain values, in hexadecimal.

    Objects of other kinds count by their type and attributes; cached properties of dataclasses do not count.
    """
    digest = hashlib.sha256()
    _add(digest, value)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    digest.update(f"<{type(value).__qualname__}>".encode())
    if isinstance(value, np.ndarray) and value.dtype != object:
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif value is None or isinstance(value, str | bytes | int | float | complex | np.generic | PurePath | Enum):
        digest.update(repr(value).encode())
    else:
        for part in _parts(value):
            _add(digest, part)
    digest.update(b"</>")


def _parts(value: Any) -> list[Any]:
    """The parts of a value, in an order that does not depend on the process."""
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
