"""Samples in free and moving spaces, a target for pinned origins, and sensors that are fitted to samples."""

from __future__ import annotations

import numpy as np

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.mixture.fit import FitProblem, FittedSensors, fit_sensors
from lidardesign.samples import Samples
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import design_document
from lidardesign.space import DesignSpace, aim, observed_point

FACE = DesignSpace((0.0, 0.0, 0.0, -0.6, -0.6, 0.05), (0.0, 0.0, 0.0, 0.6, 0.6, 1.05))

FREE = DesignSpace((-0.05, -0.05, -0.05, -0.8, -0.8, 0.05), (0.05, 0.05, 0.05, 0.8, 0.8, 1.5))

CENTRE, WIDTH = np.array([0.6, 0.0, 0.05]), 0.06


def log_target(points):
    """A Gaussian blob of scene points, per solid angle and range from anywhere."""
    return -0.5 * np.square((observed_point(points) - CENTRE) / WIDTH).sum(axis=-1)


def blob(space, count=8000, seed=0):
    """Samples of p*(d) = blob(M(d)) through scene points: their density per design point is blob r^2."""
    generator = np.random.default_rng(seed)
    scene = CENTRE + WIDTH * generator.standard_normal((count, 3))
    low, high = np.array(space.low[:3]), np.array(space.high[:3])
    points = space.wrap(aim(low + (high - low) * generator.uniform(size=(count, 3)), scene))
    points = points[space.contains(points)]
    target = log_target(points)
    return Samples(points, target + 2 * np.log(points[:, 5]), target, space)


FIXED, MOVING = blob(FACE), blob(FREE)


def fitted(samples, constraints=None, **options) -> FittedSensors:
    """The sensors that are fitted to samples under a mapping of constraints; options as of `FitProblem`."""
    options = {"em_samples": 2000, "restarts": 2, **options}
    return fit_sensors(FitProblem(samples=samples, constraints=Constraints.from_mapping(constraints or {}), **options))


def design_of(found: FittedSensors, level=0.95) -> DesignSpec:
    """The design of fitted sensors with even rays, of which there are as many as a bandwidth allows."""
    budget = {} if found.rays is None else {"budget": {"rays": found.rays}}
    return DesignSpec("fitted", found.sensors, constraints=budget, level=level)


def checks(found: FittedSensors, constraints, space, level=0.95):
    """The independent checks of fitted sensors, as they are written."""
    return check_design(design_document(design_of(found, level)), constraints, space)


def broken(found: FittedSensors, constraints, space, level=0.95) -> list[str]:
    """The names of the constraints that fitted sensors do not keep."""
    return [check.name for check in checks(found, constraints, space, level) if not check.satisfied]
