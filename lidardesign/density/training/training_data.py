"""What learning stands on, however many steps it takes: scenes, the target, and proposals for balancing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidardesign.config import RunConfig
from lidardesign.density.target.prepare import prepare_target
from lidardesign.density.target.target import Target
from lidardesign.density.training.independent import independent_points
from lidardesign.density.training.losses import Pool
from lidardesign.density.visibility.receiver import common_receiver
from lidardesign.errors import ConfigError, DataError
from lidardesign.geometry.receiver import in_view
from lidardesign.registry import plugin_guard
from lidardesign.run.clock import phase
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, direction
from lidardesign.task import Task, notes_of, random_generator, scenes_of


@dataclass(frozen=True, eq=False)
class Ground:
    """The training scenes of a task, their target, notes about it, and the proposals that balancing draws from."""

    scenes: Sequence[Scene]
    target: Target
    notes: tuple[str, ...]
    pool: Pool


def prepare_ground(task: Task, config: RunConfig) -> Ground:
    """The ground of a task; it does not depend on the steps, the flow or its optimiser.

    Arguments:
        task: The plugin.
        config: The resolved configuration.

    Raises:
        ConfigError, DataError: Unusable settings or scenes.
        PluginError: The task's own code failed.
    """
    if not set(config.space.free) - set(config.space.conditioned):
        raise ConfigError(
            "every dimension of the design space is fixed: it is one design point, with nothing to learn",
            where="space",
            hint="free at least one, or write the point as a design file",
        )
    with plugin_guard(config.task_name):
        told = notes_of(task, config.task, config.space)
    scenes = training_scenes(task, config)
    target, notes = prepare_target(scenes, config)
    return Ground(scenes, target, (*told, *notes), _pool(target, scenes, config))


@phase("scenes")
def training_scenes(task: Task, config: RunConfig) -> list[Scene]:
    """The scenes that a density is learned from.

    Raises:
        DataError: There are none.
        PluginError: The task's own code failed.
    """
    with plugin_guard(config.task_name):
        scenes = list(scenes_of(task, config.task, "train", config.seed, config.space))
    if not scenes:
        raise DataError(f"the task {config.task_name!r} gave no training scenes", where="task")
    return scenes


@phase("proposals")
def _pool(target: Target, scenes: Sequence[Scene], config: RunConfig) -> Pool:
    """Proposals for balancing, independent of those that coverage is measured on."""
    count = config.learning.balance_proposals
    generator = random_generator(config.seed, "balancing")
    points, log_density = independent_points(target, scenes, count, generator)
    if not len(points):
        raise DataError(
            "no ray of the design space reaches a target surface in any training scene",
            where="space",
            hint="widen the angles or the range, move the origin, or raise density.sigma_m",
        )
    refuse_blind_receiver(scenes, points)
    log_target = target.log_density(points)
    # points on the space's faces may leave it by rounding
    return Pool.of(config.space.to_unit(points).clip(-1.0, 1.0), log_target, log_density)


def refuse_blind_receiver(scenes: Sequence[Scene], points: np.ndarray) -> None:
    """Refuse scenes whose fixed receiver sees nothing that is lit: none of the points observed by rays (N, 6).

    Raises:
        DataError: So it is.
    """
    receiver = common_receiver(scenes)
    reached = points[:, :3] + points[:, RANGE, None] * direction(points[:, AZIMUTH], points[:, ELEVATION])
    if receiver is not None and not in_view(receiver, reached).any():
        raise DataError(
            "its field of view and range hold no surface that a ray of the design space reaches",
            where="receiver",
            hint="turn it, widen its field of view or its range, or move it",
        )
