"""The samples and the target density of a run, under settings of the task that weight them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.config import with_task_settings
from lidardesign.errors import ConfigError
from lidardesign.run.manifest import read_manifest
from lidardesign.run_folder import RunFolder
from lidardesign.sensors.design import DesignSpec

if TYPE_CHECKING:
    from lidardesign.density.objective.target import Target

KEY = "weighting"
FIT_AGAIN = "fit the design again: an earlier version refined it, or its file was changed by hand"


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
    """log p* of a run, prepared when it is first asked for: most fits never do.

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
