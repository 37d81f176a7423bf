"""What a run's samples give its designs: their weights under settings of the task, and the rays that follow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.config import with_task_settings
from lidardesign.errors import ConfigError, DataError
from lidardesign.layouts.rays import gates_of, layout_of
from lidardesign.run.manifest import read_manifest
from lidardesign.run_folder import RunFolder
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.sensor import DesignSpec
from lidardesign.task import random_generator

if TYPE_CHECKING:
    from lidardesign.density.objective.target import Target

KEY = "weighting"
FIT_AGAIN = "fit the design again: an earlier version refined it, or its file was changed by hand"
# As many samples as the standard preset of `learn` leaves.
TWIN_SAMPLES = 100_000
TWIN_NAME = "no-visibility"


@dataclass(frozen=True)
class Weighting:
    """Settings of the task to whose scenes the density of a run is weighted for a design.

    Arguments:
        settings: As KEY=VALUE; none leaves the density as it was learned.
        origin: Where they were said: an option, or a design.
    """

    settings: tuple[str, ...] = ()
    origin: str = "--weight"

    @classmethod
    def of(cls, design: DesignSpec) -> Weighting:
        """What a design says about its samples.

        Raises:
            ConfigError: It says something else.
        """
        document, where = design.provenance.get(KEY), f"{KEY} of design {design.name}"
        if document is None:
            return cls()
        if not isinstance(document, Mapping) or set(document) != {"set"}:
            found = f"keys {', '.join(map(str, document))}" if isinstance(document, Mapping) else repr(document)
            raise ConfigError(f"holds {found}", where=where, allowed="the key set alone", hint=FIT_AGAIN)
        settings = document["set"]
        if not isinstance(settings, list | tuple) or not all(isinstance(text, str) for text in settings):
            raise ConfigError(f"set is {settings!r}", where=where, allowed="a list of KEY=VALUE", hint=FIT_AGAIN)
        return cls(tuple(settings), f"{where}: set")

    def as_document(self) -> dict[str, Any]:
        """Plain values, as they stand in the provenance of a design."""
        return {"set": list(self.settings)}


class RunTarget:
    """log p* of a run, prepared when it is first asked for: most layouts never do.

    Arguments:
        run: The run.
        visibility: The visibility to take instead of what the run decided.
        weighting: Settings of the task whose scenes it is of instead.
    """

    def __init__(self, run: RunFolder, visibility: str | None = None, weighting: Weighting | None = None) -> None:
        self._run, self._visibility, self._weighting = run, visibility, weighting or Weighting()

    @cached_property
    def _target(self) -> Target:
        from lidardesign.density.objective.prepare import prepare_target

        run, weighting = self._run, self._weighting
        if weighting.settings:
            config = with_task_settings(run.task, run.config, weighting.settings, option=weighting.origin)
            run = replace(run, config=config)
        decided = self._visibility or read_manifest(run.folder).get("visibility")
        return prepare_target(run.scenes("train", run.config.seed), run.config, visibility=decided, compiled=False)[0]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Design points (N, 6) to (N,)."""
        return self._target.log_density(points)


def weighted_samples(run: RunFolder, weighting: Weighting, target: RunTarget) -> Samples:
    """The samples of a run as a design was fitted to them.

    Raises:
        DataError: The samples are damaged, or all weights are zero.
    """
    samples = load_samples(run.folder, run.config.space)
    return samples.retargeted(target(samples.points)) if weighting.settings else samples


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
        from lidardesign.mixture.fit import rays_at

        return rays_at(design, count, samples, at=at, retarget=self.targets.get(design.name))

    @classmethod
    def of(cls, designs: Sequence[tuple[DesignSpec, RunFolder]], judge: RunFolder) -> Layouts:
        """The layouts of designs by their runs; the twin takes the judging run's target without occlusion."""
        by_folder = {run.folder: RunTarget(run) for _, run in designs}
        targets = {}
        for design, run in designs:
            weighting = Weighting.of(design)
            targets[design.name] = RunTarget(run, weighting=weighting) if weighting.settings else by_folder[run.folder]
        if designs:
            targets[TWIN_NAME] = RunTarget(judge, visibility="off")
        return cls(targets)

    def samples(self, designs: Sequence[tuple[DesignSpec, RunFolder]]) -> dict[str, Samples]:
        """The samples of those designs that may need some, by name; designs of one weighting of a run share them."""
        shared: dict[Any, Samples] = {}
        by_name = {}
        for design, run in designs:
            if not (may_need_samples(design) and run.has_samples):
                continue
            weighting = Weighting.of(design)
            key = (run.folder, design.name if weighting.settings else None)
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
    from lidardesign.density.objective.proposals import samples_without_visibility
    from lidardesign.scoring.baselines.simple import fitted_twin

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
    return fitted_twin(design, samples, name=TWIN_NAME, retarget=layouts.targets[TWIN_NAME]), samples
