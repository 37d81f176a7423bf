"""Rays of a fitted design that are chosen on training scenes: `fit --layout selected`.

The density proposes rays inside the sensors; scenes that nothing was learned from say what each of them tells (see
`lidardesign.selection`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from lidardesign.design.constraints.document import Constraints
from lidardesign.design.fit import FitResult
from lidardesign.design.layouts.density import bandwidth_limit
from lidardesign.design.layouts.gates import bounded_gates
from lidardesign.design.layouts.rays import LAYOUTS
from lidardesign.design.mixture.bounds import bounds_of
from lidardesign.design.sensor import CERTIFICATES, DesignSpec, interval_factor
from lidardesign.errors import ConfigError
from lidardesign.geometry.rays import Rays
from lidardesign.run.clock import phase
from lidardesign.samples import Samples
from lidardesign.scene import Scene
from lidardesign.selection.candidates import CANDIDATES_PER_RAY, InformedScene, gate_choices
from lidardesign.selection.information import checked_information, informs_rays
from lidardesign.space import DesignSpace
from lidardesign.task import random_generator
from lidardesign.workflow.run_folder import RunFolder

MOST_CHOSEN = 5000  # rays: what candidates tell of 400 scenes then takes minutes and gigabytes
EVEN_SHARE = 0.25  # of the candidates that are even in the fields, where the density's samples may be sparse
MARGIN_SIGMAS = 2.0  # by which gates are longer than what training scenes returned, in the density's sigma


def select_rays(run: RunFolder, result: FitResult, counts: Sequence[int], samples: Samples, seed: int) -> FitResult:
    """The design of a fit with rays that were chosen, one table for each number of rays.

    Arguments:
        run: The run, whose task says what returns tell.
        result: The fitted sensors; `gates` of the design says whether rays have gates of their own.
        counts: Numbers of rays, ascending.
        samples: What the sensors were fitted to.
        seed: Root of the random streams.

    Raises:
        ConfigError: The task does not say what returns tell, or more rays than can be chosen.
        DataError: No ray inside the sensors tells anything about the training scenes.
        InfeasibleError: A bandwidth in which no choice of so many rays fits.
    """
    from lidardesign.selection.select import SelectionProblem, select

    if not informs_rays(run.task):
        raise ConfigError(
            f"the task {run.task.name} does not say what returns tell",
            where="--layout selected",
            allowed="tasks with informs",
            hint="another --layout, or give the task a method informs(scene, returns)",
        )
    if counts[-1] > MOST_CHOSEN:
        raise ConfigError(f"{counts[-1]} rays in the layout selected", where="--rays", allowed=f"at most {MOST_CHOSEN}")
    spec = result.design
    constraints = Constraints.from_mapping(spec.constraints, where=f"constraints of {spec.name}")
    # a task whose rays start all over their sensors' origins proposes such rays
    layout = "distributed" if LAYOUTS[run.task.defaults.layout].extends_origins else "density"
    rays = _proposed(spec, layout, samples, CANDIDATES_PER_RAY * counts[-1], seed)
    limit = constraints.budget.bandwidth_mbps
    problem = SelectionProblem(
        rays=rays,
        gates=partial(_gates, spec, constraints, samples.space, margin_m=gate_margin_m(run)),
        informs=partial(checked_information, run.task),
        scenes=partial(selection_scenes, run, seed),
        bandwidth=bandwidth_limit(constraints, len(rays))[0],
        limit_mbps=np.inf if limit is None else limit,
        name=spec.name,
        further=_further(spec, layout, samples, len(rays), seed),
    )
    selected = select(problem, counts)
    tables = [one.rays for one in selected]
    only = len(counts) == 1
    own = np.bincount(tables[-1].sensor, minlength=len(spec.sensors))
    sensors = (
        replace(sensor, rays=int(number) if only else None) for sensor, number in zip(spec.sensors, own, strict=True)
    )
    design = replace(
        spec,
        sensors=tuple(sensors),
        layout="selected",
        rays=counts[0] if only else None,
        ray_table=tables[-1],
        further_tables=tuple(tables[:-1]),
        provenance={**spec.provenance, CERTIFICATES: [one.certificate for one in selected]},
    )
    return replace(result, design=design)


def selection_scenes(run: RunFolder, seed: int, purpose: str) -> Iterator[Scene]:
    """Training scenes that nothing was learned from, drawn with further seeds."""
    for draw in itertools.count():
        yield from run.scenes("train", int(random_generator(seed, "selection", purpose, draw).integers(2**31)))


def gate_margin_m(run: RunFolder) -> float:
    """By how much gates are longer at both ends than what training scenes returned [m]."""
    return MARGIN_SIGMAS * run.config.density.sigma_m


@phase("candidates")
def _proposed(spec: DesignSpec, layout: str, samples: Samples, count: int, seed: int) -> Rays:
    """Rays inside the sensors, most of them where the density is, with their sensors' gates."""
    sensors = tuple(replace(sensor, rays=None) for sensor in spec.sensors)
    spec = replace(spec, ray_table=None, rays=None, sensors=sensors)
    even = round(EVEN_SHARE * count)
    parts = [
        LAYOUTS[name].lay_out(spec, number, samples, "sensor", seed)
        for name, number in ((layout, count - even), ("grid", even))
    ]
    return replace(Rays.joined(parts), time_s=np.zeros(count))


def _further(spec: DesignSpec, layout: str, samples: Samples, count: int, seed: int) -> Rays:
    """As many rays again: at random every second one of twice as many, which are elsewhere."""
    rays = _proposed(spec, layout, samples, 2 * count, seed)
    return rays.subset(np.sort(random_generator(seed, "selection", "further").permutation(2 * count)[:count]))


@phase("gates")
def _gates(
    spec: DesignSpec,
    constraints: Constraints,
    space: DesignSpace,
    rays: Rays,
    informed: Sequence[InformedScene],
    *,
    margin_m: float,
) -> np.ndarray:
    """The gates that rays may have inside the design's constraints, (N, G, 2) [m]."""
    if spec.gates != "ray":
        return rays.gate_m[:, None]
    gates_m = gate_choices(rays, informed, margin_m)
    for index, sensor in enumerate(spec.sensors):
        own = rays.sensor == index
        wanted = gates_m[own].reshape(-1, 2)
        bounds = bounds_of(constraints.rules, space, (index,), interval_factor(spec.level))
        allowed = bounded_gates(wanted, sensor, bounds.take(np.zeros(len(wanted), dtype=np.int64)))
        gates_m[own] = allowed.reshape(-1, *gates_m.shape[1:])
    return gates_m
