"""The density that a run has learned, for users: design points and their log densities as numpy arrays."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np
import torch

from lidardesign.config import RunConfig
from lidardesign.density.learn import FLOW
from lidardesign.density.training.quality import draw_samples, log_density_of
from lidardesign.density.training.snapshot_quality import LoadedFlow, load_flow
from lidardesign.errors import ConfigError
from lidardesign.space import DesignSpace


class _NoTarget:
    """Stands for the target where samples of the flow alone are wanted."""

    def log_density(self, points: np.ndarray) -> np.ndarray:
        """Nothing is known of it."""
        return np.zeros(len(points))


class LearnedDensity:
    """A normalised density over rays: design points (x, y, z, azimuth, elevation, range) in metres and radians.

    Arguments:
        run: The run folder.
        config: Its configuration.
    """

    def __init__(self, run: Path, config: RunConfig) -> None:
        self._run, self._config = run, config

    @cached_property
    def _flow(self) -> LoadedFlow:
        return load_flow(self._run, FLOW, self._config, _NoTarget(), self._config.seed)

    @property
    def space(self) -> DesignSpace:
        """The design space that it lives in."""
        return self._config.space

    def sample(self, count: int, seed: int | np.random.Generator = 0) -> np.ndarray:
        """Design points drawn from the density, shape (count, 6); the same seed gives the same points."""
        generator = np.random.default_rng(seed)
        self._flow.generator.manual_seed(int(generator.integers(2**63)))
        return draw_samples(self._flow, count).points

    def log_prob(self, points: np.ndarray) -> np.ndarray:
        """The log density per chart volume of design points, (N, 6) to (N,); -inf outside the space.

        Raises:
            ConfigError: Points of another shape.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 6:
            raise ConfigError(f"points of shape {points.shape}", where="log_prob", allowed="(N, 6)")
        with torch.no_grad():
            return log_density_of(self._flow, points)
