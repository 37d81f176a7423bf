"""What a fit comes to: a design, how good it is, and the checks of its constraints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidardesign.constraints.check import ConstraintCheck
from lidardesign.estimates import Estimate, as_documents
from lidardesign.sensors.design import DesignSpec


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted design with its quality and checks.

    Arguments:
        design: The design.
        log_likelihood: Weighted mean log density of the samples [nats]; None where it was chosen on scenes alone.
        admissible_mass: The share of the density inside the constraints; None with fixed origins, or likewise.
        ess: Effective share of the samples that were admitted, or of all where it was chosen on scenes alone, 0 to 1.
        seconds: Wall time [s].
        constraints: The independent checks.
        notes: Lines on sensors.
        numbers: By number of parts, where several were asked for: their names, score, power and price.
        error_estimates: Standard errors of log_likelihood, ess and admissible_mass.
        goal: For a goal, what was tried, as plain values.
    """

    design: DesignSpec
    log_likelihood: float | None
    admissible_mass: float | None
    ess: float
    seconds: float
    constraints: tuple[ConstraintCheck, ...] = ()
    notes: tuple[str, ...] = ()
    numbers: tuple[Mapping[str, Any], ...] = ()
    error_estimates: Mapping[str, Estimate] = field(default_factory=dict)
    goal: Mapping[str, Any] | None = None

    @property
    def satisfied(self) -> bool:
        """True where every constraint holds on the finished design."""
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
            **({"numbers": [dict(row) for row in self.numbers]} if self.numbers else {}),
            **({} if self.goal is None else {"goal": dict(self.goal)}),
        }
