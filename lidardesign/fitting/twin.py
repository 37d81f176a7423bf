"""A design's twin of the density without its occlusion term: what occlusion is worth, without learning again."""

from __future__ import annotations

from lidardesign.constraints.document import Constraints
from lidardesign.errors import DataError
from lidardesign.fitting.fit import fit_design
from lidardesign.fitting.request import FitRequest
from lidardesign.fitting.run_samples import RunTarget, Weighting
from lidardesign.run_folder import RunFolder, ignore
from lidardesign.sensors.design import DesignSpec
from lidardesign.task import random_generator

# As many samples as the standard preset of `learn` leaves.
TWIN_SAMPLES = 100_000
TWIN_NAME = "no-visibility"


def twin_without_visibility(
    design: DesignSpec, run: RunFolder, rays: int, bandwidth_mbps: float | None = None
) -> DesignSpec:
    """A design fitted to the density without its occlusion term as a given one was to its own; it is not weighted.

    Arguments:
        design: The design whose number of sensors, layout, constraints, level, gates and seed are taken.
        run: The run that judges.
        rays: Rays per frame.
        bandwidth_mbps: The most that its rays may cost; None: what the design's constraints say.

    Raises:
        DataError: No ray of the design space comes near a target.
    """
    from lidardesign.density.objective.proposals import samples_without_visibility

    config, seed = run.config, design.provenance.get("seed")
    seed = seed if isinstance(seed, int) else 0
    samples = samples_without_visibility(
        run.scenes("train", config.seed),
        config.space,
        config.density,
        TWIN_SAMPLES,
        random_generator(config.seed, "no visibility"),
    )
    if not len(samples):
        raise DataError("no ray of the design space comes near a target", where=f"--baseline {TWIN_NAME}")
    document = {key: value for key, value in design.constraints.items() if key != "parts"}
    limit = {} if bandwidth_mbps is None else {"bandwidth_mbps": bandwidth_mbps}
    document["budget"] = {**document.get("budget", {}), "rays": rays, **limit}
    # the rays of real parts and rings are what they are: sensors like those have even rays
    layout = design.layout if design.layout in ("chosen", "even") else "even"
    request = FitRequest(
        run=run,
        name=TWIN_NAME,
        seed=seed,
        constraints=Constraints.from_mapping(document, where=f"constraints of {design.name}"),
        is_constrained=True,
        at=design.at,
        sensors=len(design.sensors),
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
    return fit_design(request, notes=ignore, samples=samples, target=target).design
