"""Sweeps: error and time of a numerical choice at each of its settings.

A sweep has one measurement per setting, the roughest first. Its error is taken against a closed form or the finest
setting, and has an uncertainty of its own; the cheapest setting inside the sweep's tolerance is the one to choose.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lidardesign.numerics import TINY

Value = TypeVar("Value")

# Measurements whose times differ by less than this ratio cost the same: timings of one machine repeat no better.
SAME_COST = 1.2
# Errors that differ by less than so many standard errors of their difference do not differ.
STANDARD_ERRORS = 2.0
# A call is repeated until it took so long together, at most so often; its median counts.
TIMED_SECONDS = 0.2
MOST_REPEATS = 5
_STATUS, _CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Measurement:
    """One setting of a numerical choice.

    Arguments:
        setting: As a user would write it, for example "64" or "raycast".
        error: Against the sweep's reference, in the sweep's unit; 0 for the reference itself.
        uncertainty: Standard error of `error`, in the same unit.
        seconds: Median time of the sweep's work at this setting [s].
        memory_bytes: Peak memory of the work beyond that held before; None where it was not measured.
        default: Whether the run uses this setting.
        reference: Whether errors are taken against this measurement.
        values: Further figures of the measurement by name, with their unit in the name.
    """

    setting: str
    error: float
    uncertainty: float
    seconds: float
    memory_bytes: int | None = None
    default: bool = False
    reference: bool = False
    values: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Sweep:
    """All settings of one numerical choice that were measured.

    Arguments:
        knob: The key that sets it, for example "density.quadrature_points", or a name where no key does.
        error_of: The error in a few words.
        unit: Of errors and the tolerance; "" for shares.
        against: The reference of errors.
        tolerance: Errors up to this one do not matter, for the reason in `because`.
        because: The reason for the tolerance.
        work: The work that is timed.
        measurements: The roughest first, 1 or more.
        note: A line for readers, or "".
    """

    knob: str
    error_of: str
    unit: str
    against: str
    tolerance: float
    because: str
    work: str
    measurements: Sequence[Measurement]
    note: str = ""

    @property
    def chosen(self) -> Measurement:
        """The cheapest inside the tolerance, uncertainty included; of those that cost the same, the most accurate.

        The run's own setting is kept where it is inside the tolerance and none there is significantly better. Where no
        measurement is inside the tolerance, the most accurate one.
        """
        inside = [one for one in self.measurements if one.error + one.uncertainty <= self.tolerance]
        if not inside:
            return min(self.measurements, key=lambda one: (one.error, one.seconds))
        least = min(one.seconds for one in inside)
        cheap = (one for one in inside if one.seconds <= SAME_COST * least)
        best = min(cheap, key=lambda one: (not one.default, one.error, one.seconds))
        no_worse = (
            one
            for one in inside
            if one.default
            and one.seconds <= SAME_COST * best.seconds
            and one.error - best.error <= _sure_difference(one, best)
        )
        return next(no_worse, best)

    @property
    def default(self) -> Measurement | None:
        """The measurement that the run uses, where it is among those measured."""
        return next((measurement for measurement in self.measurements if measurement.default), None)

    @property
    def falls(self) -> bool:
        """True where errors fall from measurement to measurement, within their own uncertainty."""
        pairs = zip(self.measurements, self.measurements[1:], strict=False)
        return all(finer.error <= rougher.error + _sure_difference(finer, rougher) for rougher, finer in pairs)

    @property
    def verdict(self) -> str:
        """The chosen setting compared with the run's own, in one line, with a doubt where errors do not fall."""
        return self._comparison + ("" if self.falls else "; but errors do not fall here: by chance, perhaps")

    @property
    def _comparison(self) -> str:
        chosen, default = self.chosen, self.default
        if chosen.error + chosen.uncertainty > self.tolerance:
            return f"no setting is within {self.tolerance:g} {self.unit}".rstrip() + f"; {chosen.setting} is closest"
        if default is None:
            return f"{chosen.setting} suffices"
        if chosen is default:
            return f"{chosen.setting}, the setting of this run, is the one to choose"
        if default.error + default.uncertainty > self.tolerance:
            verdict = "is needed" if chosen.seconds > default.seconds else "is good enough"
            return f"{chosen.setting} {verdict}: {default.setting}, as this run has it, may be outside the tolerance"
        ratio = default.seconds / max(chosen.seconds, TINY)
        if ratio <= SAME_COST:
            return f"{chosen.setting} costs the same as {default.setting}, the setting of this run, and errs less"
        return f"{chosen.setting} suffices, {ratio:.2g} times cheaper than {default.setting}, the setting of this run"

    def as_rows(self) -> list[dict[str, Any]]:
        """The contract's JSON form: one object per measurement."""
        chosen = self.chosen
        return [
            {
                "knob": self.knob,
                "setting": measurement.setting,
                "error": measurement.error,
                "uncertainty": measurement.uncertainty,
                "unit": self.unit,
                "seconds": measurement.seconds,
                "memory_bytes": measurement.memory_bytes,
                "tolerance": self.tolerance,
                "chosen": measurement is chosen,
                "default": measurement.default,
                "reference": measurement.reference,
                "values": dict(measurement.values),
            }
            for measurement in self.measurements
        ]


@dataclass(frozen=True, eq=False)
class Accuracy:
    """All sweeps, and the time that each module of them took [s]."""

    sweeps: Sequence[Sweep]
    seconds: dict[str, float]

    def as_rows(self) -> list[dict[str, Any]]:
        """The contract's `accuracy` list."""
        return [row for sweep in self.sweeps for row in sweep.as_rows()]


def _sure_difference(first: Measurement, second: Measurement) -> float:
    return STANDARD_ERRORS * math.hypot(first.uncertainty, second.uncertainty)


def timed(call: Callable[[], Value]) -> tuple[Value, float, int | None]:
    """A call's value, the median of its times [s], and the memory that its first run took at most [bytes].

    It is called once to warm up and to measure memory, then until `TIMED_SECONDS` have passed.
    """
    started = time.perf_counter()
    value, memory = with_memory(call)
    first = time.perf_counter() - started
    if first > 10 * TIMED_SECONDS:
        return value, first, memory
    times: list[float] = []
    while len(times) < MOST_REPEATS and sum(times) < TIMED_SECONDS:
        started = time.perf_counter()
        call()
        times.append(time.perf_counter() - started)
    return value, float(np.median(times)), memory


def with_memory(call: Callable[[], Value]) -> tuple[Value, int | None]:
    """A call's value and the rise of peak resident memory during it [bytes].

    None where the system does not report it (Linux does).
    """
    before = None
    with contextlib.suppress(OSError):
        _CLEAR.write_text("5", encoding="ascii")
        before = _resident("VmRSS")
    value = call()
    peak = None if before is None else _resident("VmHWM")
    return value, None if peak is None else max(peak - before, 0)


def _resident(name: str) -> int | None:
    """A size of this process from the system's status [bytes]."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        for line in _STATUS.read_text(encoding="ascii").splitlines():
            if line.startswith(f"{name}:"):
                return 1024 * int(line.split()[1])
    return None
