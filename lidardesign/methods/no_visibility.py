"""The method `no-visibility`: the first design fitted anew to the density without its occlusion term.

The number of sensors, the layout, the constraints, the level and the seed stay. It is not weighted, even where the
design is.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, DataError, InfeasibleError
from lidardesign.fitting.fit import fit_design
from lidardesign.fitting.request import FitRequest, RunTarget, Weighting
from lidardesign.problem.method import DESIGN, Method
from lidardesign.problem.problem import DesignResult, Problem
from lidardesign.run_folder import RunFolder, ignore
from lidardesign.samples import Samples
from lidardesign.sensors.design import DesignSpec
from lidardesign.task import random_generator

# As many samples as the standard preset of `learn` leaves.
TWIN_SAMPLES = 100_000
TWIN_NAME = "no-visibility"
FEWER_RAYS = 0.9  # of those that did not fit in a bandwidth


class WithoutVisibility(Method):
    """The method: see `Method`."""

    name = TWIN_NAME
    summary = "the first design refitted to the density without its occlusion term"
    needs = frozenset({DESIGN})

    def design(self, problem: Problem) -> DesignResult | None:
        """See `Method`: as many rays as the design of a bandwidth fires, or fewer where its own gates need more.

        Raises:
            ConfigError: There is no design whose run is at hand.
        """
        refit, count = problem.compared.refit, problem.asked
        if refit is None:
            raise ConfigError(
                "there is no design to refit without occlusion",
                where=f"--baseline {self.name}",
                allowed="at least one design whose run can be found",
                hint="evaluate the run, or a design in its folder",
            )
        if problem.rays is not None:
            return DesignResult(refit(count, None))
        while True:
            try:
                return DesignResult(refit(count, problem.limit_mbps))
            except InfeasibleError as error:
                if count == 1 or "budget.bandwidth_mbps" not in error.conflicts:
                    raise
                count = math.floor(FEWER_RAYS * count)


NO_VISIBILITY = WithoutVisibility()


def twin_samples(run: RunFolder) -> Samples:
    """Samples of a run's density without its occlusion term.

    Raises:
        DataError: No ray of the design space comes near a target.
    """
    from lidardesign.density.objective.proposals import samples_without_visibility

    config = run.config
    samples = samples_without_visibility(
        run.scenes("train", config.seed),
        config.space,
        config.density,
        TWIN_SAMPLES,
        random_generator(config.seed, "no visibility"),
    )
    if not len(samples):
        raise DataError("no ray of the design space comes near a target")
    return samples


def twin_without_visibility(
    design: DesignSpec,
    run: RunFolder,
    rays: int,
    bandwidth_mbps: float | None = None,
    samples: Callable[[], Samples] | None = None,
) -> DesignSpec:
    """A design fitted to the density without its occlusion term as a given one was to its own; it is not weighted.

    Arguments:
        design: The design whose number of sensors, layout, constraints, level, gates and seed are taken.
        run: The run that judges.
        rays: Rays per frame.
        bandwidth_mbps: Its largest bandwidth, by the read-out model of evaluations; None: that of the design's
            constraints, by their model.
        samples: The samples, which several twins may share; None draws them.

    Raises:
        DataError: No ray of the design space comes near a target, or too few for so many sensors.
        InfeasibleError: The twin cannot keep the design's constraints.
    """
    seed = design.provenance.get("seed")
    seed = seed if isinstance(seed, int) else 0
    document = {key: value for key, value in design.constraints.items() if key != "parts"}
    if rays == 1:
        document.pop("survive", None)
    # a bandwidth is one of evaluations, whatever bits the design was made for
    budget = document.get("budget", {}) if bandwidth_mbps is None else {"bandwidth_mbps": bandwidth_mbps}
    document["budget"] = {**budget, "rays": rays}
    # the rays of real parts and rings are what they are: sensors like those have even rays
    layout = design.layout if design.layout in ("chosen", "even") else "even"
    request = FitRequest(
        run=run,
        name=TWIN_NAME,
        seed=seed,
        constraints=Constraints.from_mapping(document, where=f"constraints of {design.name}"),
        is_constrained=True,
        at=design.at,
        sensors=min(len(design.sensors), rays),
        layout=layout,
        rays=rays,
        gates="ray" if design.has_gates_per_ray and layout == "chosen" else "sensor",
        level=design.level,
        weighting=Weighting(),
        channels=None,
        names=(),
        certify=False,
    )
    target = RunTarget(run, visibility="off")
    try:
        drawn = twin_samples(run) if samples is None else samples()
        return fit_design(request, notes=ignore, samples=drawn, target=target).design
    except (DataError, InfeasibleError) as error:
        error.where, error.hint = f"--baseline {TWIN_NAME}", "evaluate without it"
        raise
