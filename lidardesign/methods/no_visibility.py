"""The method `no-visibility`: the first design fitted anew to the density without its occlusion term.

The number of sensors, the layout, the constraints, the level and the seed stay. It is not weighted, even where the
design is.
"""

from __future__ import annotations

import math

from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.problem.method import API_VERSION, DESIGN
from lidardesign.problem.problem import DesignResult, Problem

FEWER_RAYS = 0.9  # of those that did not fit in a bandwidth


class NoVisibility:
    """The method: see `Method`."""

    name = "no-visibility"
    summary = "the first design refitted to the density without its occlusion term"
    api_version = API_VERSION
    needs = frozenset({DESIGN})
    is_redrawn = False

    def refuses(self, problem: Problem) -> str | None:
        """See `Method`."""
        return None

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


NO_VISIBILITY = NoVisibility()
