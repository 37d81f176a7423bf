"""What a fit gives: the design, how good it is, and how far these figures may be off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidardesign.design.check import ConstraintCheck
from lidardesign.design.sensor import Design
from lidardesign.estimates import Estimate, as_documents


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted design and how good it is.

    Arguments:
        design: The design; its provenance is for the caller to fill.
        log_likelihood: Weighted mean log density of the samples [nats].
        admissible_mass: The share of the density inside the constraints; None with pinned origins.
        ess: Effective share of the samples that were admitted, 0 to 1.
        satisfied: Whether every constraint holds on the finished design.
        constraints: The independent checks.
        seconds: Wall time [s].
        notes: What happened to sensors, one line each.
        error_estimates: How far log_likelihood, ess and admissible_mass may be off, and the rays of sensors.
        snap: What sensors lost that became parts, as plain values; None where none did.
    """

    design: Design
    log_likelihood: float
    admissible_mass: float | None
    ess: float
    satisfied: bool
    constraints: list[ConstraintCheck]
    seconds: float
    notes: tuple[str, ...] = field(default=())
    error_estimates: Mapping[str, Estimate] = field(default_factory=dict)
    snap: Mapping[str, Any] | None = None

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON keys; the path of the design is for the caller to fill."""
        snap = {} if self.snap is None else {"snap": dict(self.snap)}
        return {
            "design": self.design.name,
            "sensors": [sensor.as_dict() for sensor in self.design.sensors],
            "log_likelihood": self.log_likelihood,
            "admissible_mass": self.admissible_mass,
            "ess": self.ess,
            "satisfied": self.satisfied,
            "constraints": [check.as_dict() for check in self.constraints],
            "seconds": self.seconds,
            "error_estimates": as_documents(self.error_estimates),
            **snap,
        }
