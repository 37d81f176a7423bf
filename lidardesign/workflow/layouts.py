"""How commands turn designs into rays: from their runs' samples, and asking their runs' target where needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

from lidardesign.errors import DataError
from lidardesign.workflow.weighting import Weighting

if TYPE_CHECKING:
    import numpy as np

    from lidardesign.density.target.target import Target
    from lidardesign.design.sensor import DesignSpec
    from lidardesign.evaluate.baselines.catalog import Density
    from lidardesign.geometry.rays import Rays
    from lidardesign.samples import Samples
    from lidardesign.workflow.runs import Run

# As many samples as the standard preset of `learn` leaves.
TWIN_SAMPLES = 100_000
TWIN_NAME = "no-visibility"


class RunTarget:
    """log p* of a run, prepared when it is first asked for: most layouts never do.

    Arguments:
        run: The run.
        visibility: The visibility to take instead of what the run decided.
        weighting: Settings of the task whose scenes it is of instead, and a factor.
    """

    def __init__(self, run: Run, visibility: str | None = None, weighting: Weighting | None = None) -> None:
        self._run, self._visibility = run, visibility
        self._weighting = Weighting() if weighting is None else weighting

    @cached_property
    def _target(self) -> Target:
        from lidardesign.density.target.prepare import prepare_target
        from lidardesign.run.manifest import read_manifest

        run = self._weighed()
        decided = self._visibility or read_manifest(run.folder).get("visibility")
        scenes = run.scenes("train", run.config.seed)
        return prepare_target(scenes, run.config, visibility=decided, compiled=False)[0]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Design points (N, 6) to (N,)."""
        values = self._target.log_density(points)
        factor = self._weighting.reweighting
        return values if factor is None else values + factor.log_factor(points)

    def _weighed(self) -> Run:
        """The run with the settings of its weighting."""
        from lidardesign.config import judged_by

        run, settings = self._run, self._weighting.settings
        if not settings:
            return run
        return replace(run, config=judged_by(run.task, run.config, settings, option=self._weighting.origin))


@dataclass(frozen=True, eq=False)
class Layouts:
    """Lays designs out, each by its own run.

    Arguments:
        targets: The target of each design's run, by the design's name.
    """

    targets: Mapping[str, RunTarget]

    def __call__(
        self, design: DesignSpec, count: int, samples: Samples | None, *, at: Mapping[str, float] | None = None
    ) -> Rays:
        """A design's rays at a number of rays, with a gate per ray where its own table has one per ray."""
        from lidardesign.design.layouts.rays import gates_of, lay_out

        gates = gates_of(design, samples)
        return lay_out(design, count, samples, gates=gates, at=at, retarget=self.targets.get(design.name))


def may_need_samples(design: DesignSpec) -> bool:
    """Whether another number of rays of a design may follow from samples of its run."""
    return design.layout != "fixed" and (design.layout != "grid" or design.ray_table is not None)


def twin_without_visibility(design: DesignSpec, run: Run, layouts: Layouts) -> tuple[DesignSpec, Samples]:
    """A design's twin of the density without its occlusion term, and the samples that it was fitted to.

    Raises:
        DataError: No ray of the design space comes near a target.
    """
    from lidardesign.density.training.independent import samples_without_visibility
    from lidardesign.evaluate.baselines.no_visibility import fitted_twin
    from lidardesign.task import random_generator

    config = run.config
    samples = samples_without_visibility(
        run.scenes("train", config.seed),
        config.space.at(design.at),
        config.density,
        TWIN_SAMPLES,
        random_generator(config.seed, "no visibility"),
    )
    if not len(samples):
        raise DataError("no ray of the design space comes near a target", where=f"--baseline {TWIN_NAME}")
    target = layouts.targets[TWIN_NAME]
    return fitted_twin(design, samples, name=TWIN_NAME, retarget=target), samples


def learned_density(run: Run) -> Density | None:
    """What a run has learned; None where it has no samples."""
    from lidardesign.evaluate.baselines.catalog import Density
    from lidardesign.samples import FILE_NAME, load_samples

    return Density(load_samples(run.folder), RunTarget(run)) if (run.folder / FILE_NAME).exists() else None


def layouts_of(made: Sequence[tuple[DesignSpec, Run]]) -> Layouts:
    """The layouts of designs by their runs; the twin takes the first run's target without occlusion."""
    by_folder = {run.folder: RunTarget(run) for _, run in made}
    targets = {}
    for design, run in made:
        weighting = Weighting.of(design)
        targets[design.name] = RunTarget(run, weighting=weighting) if weighting else by_folder[run.folder]
    if made:
        targets[TWIN_NAME] = RunTarget(made[0][1], visibility="off")
    return Layouts(targets)
