"""What a fit or a choice came to: the design, its checks, and how far its figures may be off."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidardesign.constraints.check import ConstraintCheck
from lidardesign.estimates import Estimate, as_documents
from lidardesign.mixture.fit import FittedSensors
from lidardesign.samples import Samples
from lidardesign.sensors.design import DesignSpec


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted design and how good it is.

    Arguments:
        design: The design.
        log_likelihood: Weighted mean log density of the samples [nats]; None of a design that was chosen on scenes alone.
        admissible_mass: The share of the density inside the constraints; None with fixed origins.
        ess: Effective share of the samples that were admitted, 0 to 1.
        seconds: Wall time [s].
        constraints: The independent checks.
        notes: What happened to sensors, one line each.
        error_estimates: How far log_likelihood, ess and admissible_mass may be off.
    """

    design: DesignSpec
    log_likelihood: float | None
    admissible_mass: float | None
    ess: float
    seconds: float
    constraints: tuple[ConstraintCheck, ...] = ()
    notes: tuple[str, ...] = ()
    error_estimates: Mapping[str, Estimate] = field(default_factory=dict)

    @classmethod
    def of_fit(cls, design: DesignSpec, fitted: FittedSensors, samples: Samples, seconds: float) -> FitResult:
        """A design whose sensors were fitted to samples."""
        value, estimates = fitted.log_likelihood.value, fitted.estimates(samples)
        mass = fitted.admissible_mass
        return cls(design, value, mass, fitted.ess, seconds, notes=fitted.notes, error_estimates=estimates)

    @classmethod
    def of_choice(cls, design: DesignSpec, samples: Samples, seconds: float) -> FitResult:
        """A design that was chosen on scenes instead of being fitted to samples."""
        return cls(design, None, None, samples.effective_sample_size, seconds)

    @property
    def satisfied(self) -> bool:
        """Whether every constraint holds on the finished design."""
        return all(check.satisfied for check in self.constraints)

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON keys; the path of the design is for the caller to fill."""
        return {
            "design": self.design.name,
            "frame": self.design.mount or "world",
            "sensors": [sensor.as_dict() for sensor in self.design.sensors],
            "log_likelihood": self.log_likelihood,
            "admissible_mass": self.admissible_mass,
            "ess": self.ess,
            "satisfied": self.satisfied,
            "constraints": [check.as_dict() for check in self.constraints],
            "seconds": self.seconds,
            "error_estimates": as_documents(self.error_estimates),
        }
