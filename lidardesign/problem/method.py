"""Methods make designs: the contract of plugins of the entry-point group `lidardesign.methods`.

Experimental: it may change with the next version.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import numpy as np

from lidardesign.errors import ConfigError, LidardesignError, PluginError
from lidardesign.numerics import COARSE_SLACK
from lidardesign.plugins import AUTHOR_HINT, PluginKind, check_members, plugin_guard
from lidardesign.problem.problem import DesignResult, Problem
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.design import DesignSpec
from lidardesign.space import RANGE

API_VERSION = 1
# What a method may need: a task with `informs`, or a design that it begins with.
INFORMS, DESIGN = "informs", "design"


class Method(Protocol):
    """A way to make a design; a subclass has what is usual.

    Arguments:
        name: Of its entry point.
        summary: One line for lists.
        api_version: `API_VERSION`.
        needs: Of `INFORMS` and `DESIGN`, those without which it makes nothing.
        is_redrawn: Whether it draws another design for every scene.
    """

    name: str
    summary: str
    api_version: int = API_VERSION
    needs: frozenset[str] = frozenset()
    is_redrawn: bool = False

    def refuses(self, problem: Problem) -> str | None:
        """The reason why it makes no design for a problem; None where it makes one, empty where nobody need know."""
        return None

    def design(self, problem: Problem) -> DesignResult | None:
        """The design for a problem; None where any number of rays fits in its bandwidth.

        Raises:
            InfeasibleError: Not one ray fits.
        """


def check_method(name: str, method: Any) -> Mapping[str, Any]:
    """Check a method by its contract; returns what lists say of it.

    Raises:
        PluginError: The first member that is missing or of the wrong type.
    """
    kinds = {"name": str, "summary": str, "needs": frozenset, "is_redrawn": bool}
    check_members("method", name, method, API_VERSION, **kinds, refuses=object, design=object)
    return {"summary": method.summary, "needs": sorted(method.needs), "redrawn": method.is_redrawn}


METHODS: PluginKind[Method] = PluginKind("lidardesign.methods", "method", check_method)


@contextlib.contextmanager
def _contained(method: Method) -> Iterator[None]:
    """Run a method's code; what another package's configures wrongly, as rays of NaN, is no fault of the user."""
    try:
        with plugin_guard(method.name, "method"):
            yield
    except ConfigError as error:
        if METHODS.is_shipped(method.name):
            raise
        raise PluginError(str(error), where=f"method {method.name}", hint=AUTHOR_HINT) from error


def refusal_of(method: Method, problem: Problem) -> str | None:
    """The reason why a method makes no design for a problem, or None."""
    with _contained(method):
        return method.refuses(problem)


def design_by(method: Method, problem: Problem) -> DesignResult | None:
    """The design that a method makes for a problem, checked.

    Raises:
        PluginError: The method raised, or made something else than what was asked for.
    """
    with _contained(method):
        result = method.design(problem)
    fault = fault_of(result, problem, is_trusted=METHODS.is_shipped(method.name))
    if fault is not None:
        raise PluginError(f"its design {fault}", where=f"method {method.name}")
    return result


def fault_of(result: Any, problem: Problem, *, is_trusted: bool) -> str | None:
    """What a design is not that a problem asks for; of a trusted one whether it can be fired alone."""
    if result is None and problem.rays is None:
        return None
    design = getattr(result, "design", None)
    if not isinstance(design, DesignSpec):
        return f"is of type {type(design).__name__}"
    world, count = problem.world, design.count if problem.rays is None else problem.rays
    try:
        lists = tuple(design.rays(count, at=condition or None) for condition in world.conditions)
    except LidardesignError as error:
        return f"cannot be fired: {error.message}"
    if is_trusted:
        return None
    # a fixed pattern would fire a subset of its rays
    if design.count != count or any(len(rays) != count for rays in lists):
        return f"fires {design.count} rays, not {count}"
    if mean_mbps(lists, problem.readout) > problem.limit_mbps * (1 + COARSE_SLACK):
        return f"needs {mean_mbps(lists, problem.readout):.6g} Mbit/s, more than {problem.limit_mbps:.6g}"
    for rays, space in zip(lists, world.spaces, strict=True):
        points = np.tile(np.asarray(space.low), (len(rays), 1))
        points[:, :RANGE] = np.column_stack([rays.origin_m, rays.azimuth_rad, rays.elevation_rad])
        if not space.contains(space.wrap(points)).all():
            return "has rays outside the design space"
    return None
