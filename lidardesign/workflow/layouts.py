"""How designs become rays: from their runs' samples, and asking their runs' target where needed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lidardesign.design.fit import rays_at
from lidardesign.design.layouts.rays import gates_of, layout_of
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError
from lidardesign.geometry.rays import Rays
from lidardesign.samples import Samples, load_samples
from lidardesign.task import random_generator
from lidardesign.workflow.run_folder import RunFolder
from lidardesign.workflow.weighting import RunTarget, Weighting, weighted_samples

if TYPE_CHECKING:
    from lidardesign.evaluate.baselines.catalog import Density

# As many samples as the standard preset of `learn` leaves.
TWIN_SAMPLES = 100_000
TWIN_NAME = "no-visibility"


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
        """A design's rays at a number of rays."""
        return rays_at(design, count, samples, at=at, retarget=self.targets.get(design.name))

    @classmethod
    def of(cls, designs: Sequence[tuple[DesignSpec, RunFolder]]) -> Layouts:
        """The layouts of designs by their runs; the twin takes the first run's target without occlusion."""
        by_folder = {run.folder: RunTarget(run) for _, run in designs}
        targets = {}
        for design, run in designs:
            weighting = Weighting.of(design)
            targets[design.name] = RunTarget(run, weighting=weighting) if weighting else by_folder[run.folder]
        if designs:
            targets[TWIN_NAME] = RunTarget(designs[0][1], visibility="off")
        return cls(targets)

    def samples(self, designs: Sequence[tuple[DesignSpec, RunFolder]]) -> dict[str, Samples]:
        """The samples of those designs that may need some, by name; designs of one weighting of a run share them."""
        shared: dict[Any, Samples] = {}
        by_name = {}
        for design, run in designs:
            if not (may_need_samples(design) and run.has_samples):
                continue
            weighting = Weighting.of(design)
            key = (run.folder, design.name if weighting else None)
            if key not in shared:
                shared[key] = weighted_samples(run, weighting, self.targets[design.name])
            by_name[design.name] = shared[key]
        return by_name


def may_need_samples(design: DesignSpec) -> bool:
    """Whether another number of rays of a design may follow from samples of its run."""
    return layout_of(design).uses_samples(design, None, gates_of(design))


def twin_without_visibility(design: DesignSpec, run: RunFolder, layouts: Layouts) -> tuple[DesignSpec, Samples]:
    """A design's twin of the density without its occlusion term, and the samples that it was fitted to.

    Raises:
        DataError: No ray of the design space comes near a target.
    """
    from lidardesign.density.target.proposals import samples_without_visibility
    from lidardesign.evaluate.baselines.no_visibility import fitted_twin

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


def learned_density(run: RunFolder) -> Density | None:
    """What a run has learned; None where it has no samples."""
    from lidardesign.evaluate.baselines.catalog import Density

    return Density(load_samples(run.folder), RunTarget(run)) if run.has_samples else None
