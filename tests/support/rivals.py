"""Baselines, each at the number of rays or in the bandwidth that a test asks for."""

from __future__ import annotations

from lidardesign.evaluate.baselines.simple import Baselines


class Rivals(Baselines):
    def positions(self, name, count):
        return self.best([(name, self.options(name, count))])[0].positions

    def positions_within(self, name, limit_mbps, bandwidth):
        return self.best([(name, self.options_within(name, limit_mbps, bandwidth))])[0].positions
