"""The rivals of designs: what methods make for as many rays, and in the bandwidth of each design.

Methods see training scenes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from lidardesign.errors import BackgroundNote, InfeasibleError
from lidardesign.evaluation.entries import SINGLE, Entry
from lidardesign.evaluation.request import EvaluationRequest
from lidardesign.methods.cma import SearchRecord
from lidardesign.problem.method import METHODS, Method, design_by, refusal_of
from lidardesign.problem.problem import NOTHING_FITS, Comparison, Fired, Problem
from lidardesign.run.clock import phase
from lidardesign.scenes.rays import Rays
from lidardesign.scoring.fired import ONE_DEVICE, Devices, Positions, fired
from lidardesign.sensors.adaptive import AdaptiveRays
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.pattern import TRAVELLED
from lidardesign.task import prepares

NO_RAYS = Rays(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty(0), np.empty(0))


@dataclass
class Rivals:
    """The entries of rivals, and what has none.

    Arguments:
        entries: The entries.
        notes: Lines on methods: why they made no design, and their own.
        unbounded: Designs and methods of which any number of rays fits in the design's bandwidth.
    """

    entries: list[Entry] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unbounded: set[tuple[str, str]] = field(default_factory=set)

    def note(self, line: str) -> None:
        """Add a line, once; an empty one is none."""
        self.notes += [line] if line and line not in self.notes else []


@phase("rays")
def rivals_of(request: EvaluationRequest, designs: Sequence[Entry], counts: Sequence[int]) -> Rivals:
    """What the methods of a request make at numbers of rays, then in the bandwidth of each design at one of them.

    Raises:
        ConfigError: A method needs a design, and there is none.
        PluginError: A method raised, or made something else than what was asked for.
    """
    methods, found = [METHODS.load(name) for name in request.baselines], Rivals()
    if methods and len(request.conditions) > 1 and [*request.conditions[0]] not in [[name] for name in TRAVELLED]:
        names = " and ".join(request.conditions[0])
        found.notes = [f"baselines are left out: rays follow where sensors stand, but not {names}"]
        return found
    problem = Problem(
        request.world,
        readout=request.bandwidth,
        gates="ray" if any(design.has_gates_per_ray for design in request.designs) else "sensor",
        compared=_comparison(request, designs, counts),
    )
    for method in methods:
        for count in counts:
            _add(request, found, method, replace(problem, rays=count))
    for entry in designs if request.equal_bandwidth else ():
        for method in methods if entry.rays in counts else ():
            _add(request, found, method, replace(problem, limit_mbps=entry.mbps(request.bandwidth)), entry)
    problem.world.forget(but=[method.name for method in methods if method.is_redrawn])
    return found


def _comparison(request: EvaluationRequest, designs: Sequence[Entry], counts: Sequence[int]) -> Comparison:
    # a search starts from single patterns of the first design
    first = [design.name for design in request.designs[:1]]
    named = [*first, *(f"{name}{SINGLE}" for name in first)]
    starts = [one for one in designs if one.name in named and not isinstance(one.positions, AdaptiveRays)]
    devices = (Devices.of(one.positions) for one in designs)
    return Comparison(
        request.designs,
        [Fired(entry.rays, entry.mbps(request.bandwidth)) for entry in designs],
        starts={one.rays: one.positions for one in starts},
        counts=counts,
        devices=max(devices, key=lambda one: one.number, default=ONE_DEVICE),
        refit=request.without_visibility,
    )


def _add(
    request: EvaluationRequest, found: Rivals, method: Method, problem: Problem, matched: Entry | None = None
) -> None:
    """Add the entry of a method for a problem, in the bandwidth of an entry where that is given; or why not."""
    problem = replace(problem, config=request.settings.get(method.name))
    refusal = refusal_of(method, problem)
    if refusal is not None:
        has_row = matched and any((one.name, one.rays) == (method.name, matched.rays) for one in found.entries)
        at = " at equal bandwidth" if has_row else ""
        found.note(f"{method.name} is left out{at}: {refusal}" if refusal else "")
        return
    rays_of: Callable[[DesignSpec], Positions] = partial(fired, conditions=request.conditions, planner=request.planner)
    search, redraw = None, None
    try:
        result = design_by(method, problem)
        if result is None:
            found.unbounded.add((matched.name, method.name))
            return
        for note in result.notes:
            found.note(note)
        design = result.design
        positions = rays_of(design, design.count if problem.rays is None else problem.rays)
        search = design.provenance.get("search") if matched is None else None
    except InfeasibleError as error:
        if matched is None or error.message != NOTHING_FITS:
            raise
        positions = tuple(NO_RAYS for _ in request.conditions)
    if method.is_redrawn and prepares(request.task):
        found.note(BackgroundNote(f"{method.name} fires one draw in all scenes, for which the task prepares"))
    elif method.is_redrawn and len(positions[0]):
        redraw = partial(_redrawn, method, replace(problem, rays=len(positions[0])), rays_of)
    found.entries.append(
        Entry(
            method.name,
            positions,
            baseline=True,
            redraw=redraw,
            matched_to=None if matched is None else matched.name,
            matched_rays=None if matched is None else matched.rays,
            search=search and SearchRecord(**search),
            devices=problem.compared.devices if matched is None else Devices.of(matched.positions),
        )
    )


def _redrawn(
    method: Method, problem: Problem, rays_of: Callable[[DesignSpec, int], Positions], scene: int
) -> Positions:
    return rays_of(design_by(method, replace(problem, draw=scene)).design, problem.rays)
