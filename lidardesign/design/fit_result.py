"""What a fit gives: the design, how good it is, and how far these figures may be off.

How far the figures of a fit may be off: over other samples of the density, and because rays are whole.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidardesign.design.constraints.check import ConstraintCheck
from lidardesign.design.mixture.ensemble import Ensemble
from lidardesign.design.mixture.mixture import log_density
from lidardesign.design.mixture.support import Support
from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.estimates import ROUNDING, Estimate, as_documents, effective_share_error
from lidardesign.samples import Samples


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

    design: DesignSpec
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


def fit_estimates(
    log_likelihood: Estimate, supports: Sequence[Support], samples: Samples, sensors: Sequence[Sensor]
) -> dict[str, Estimate]:
    """Everything that a fit reports with an error, by name."""
    found = {"log_likelihood": log_likelihood, **sample_estimates(supports, samples)}
    rays = rays_estimate(sensors)
    return found if rays is None else {**found, "rays": rays}


def sample_estimates(supports: Sequence[Support], samples: Samples) -> dict[str, Estimate]:
    """The admitted samples' ESS, and the share of the density that they stand for where that is known."""
    sizes = np.array([len(support.points) for support in supports])
    errors = np.array([effective_share_error(support.weights) for support in supports])
    share = sum(support.effective for support in supports) / max(sizes.sum(), 1)
    found = {"ess": Estimate(share, float(np.linalg.norm(sizes * errors)) / max(int(sizes.sum()), 1))}
    masses = [support.mass for support in supports]
    if None not in masses:
        widest = max(supports, key=lambda support: support.total)
        found["admissible_mass"] = Estimate(widest.total, mass_error(widest, samples))
    return found


def mass_error(support: Support, samples: Samples) -> float:
    """The standard error of the share m of the density inside the constraints, of weights that sum to 1 in all.

    sum over all samples of (w (inside - m))^2, by the sums of squares of the weights inside and outside.
    """
    inside = float(np.square(support.weights).sum())
    everything = float(np.square(samples.weights).sum())
    mass = support.total
    return math.sqrt((1 - mass) ** 2 * inside + mass**2 * max(everything - inside, 0.0))


def likelihood_error(ensemble: Ensemble, supports: Sequence[Support]) -> float:
    """The standard error of the log-likelihood over other samples [nats].

    A fit on fewer samples than were admitted knows as much as they are worth, and one on more no more than those.
    That the sensors were fitted to these very samples is not in it.
    """
    variance = 0.0
    for part, trace, support in zip(ensemble.parts, ensemble.traces, supports, strict=True):
        weights = part.features.weights
        # as long as finding the components took, where there are hundreds of them
        values = log_density(trace.mixture, part.features) if trace.values is None else trace.values
        spread = float(weights @ np.square(values - weights @ values))
        variance += part.share**2 * spread / min(support.effective, len(values))
    return math.sqrt(variance)


def rays_estimate(sensors: Sequence[Sensor]) -> Estimate | None:
    """How many of the rays a sensor's weight would give to another one: rays are whole. None where they are open."""
    counts = [sensor.rays for sensor in sensors]
    if any(count is None for count in counts):
        return None
    rays = np.array(counts, dtype=np.float64)
    wanted = rays.sum() * np.array([sensor.weight for sensor in sensors])
    return Estimate(float(rays.sum()), float(np.abs(rays - wanted).sum() / 2), "rays", ROUNDING)
