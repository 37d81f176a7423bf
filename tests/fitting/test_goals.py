"""A design for a goal: the least of something whose score keeps it, and the design that one gets by asking for that."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.sensors import normal_sensor

from lidardesign.errors import InfeasibleError
from lidardesign.fitting.request import FitRequest
from lidardesign.fitting.trials import FINENESS, GoalSearch, rounded_up
from lidardesign.run_folder import RunFolder
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design import DesignSpec
from lidardesign.task import Metric

COUNTS = (1, 2, 3, 4, 6, 8)
ONE_BIN = Bandwidth().mbps_of_widths(np.zeros(1))
MOST_BINS = 12


def made_up(request):
    """A design in its bandwidth: `MOST_BINS` of each ray without a limit."""
    bins, limit = MOST_BINS, request.constraints.budget.bandwidth_mbps
    if limit is not None:
        bins = min(bins, math.floor(limit / request.rays / ONE_BIN * (1 + 1e-9)))
    if bins < 1:
        raise InfeasibleError("too narrow", conflicts=["budget.bandwidth_mbps"])
    sensor = normal_sensor(origin_m=(0.5, 0, 0), azimuth_rad=1.6, range_m=0.7)
    count = request.sensors if isinstance(request.sensors, int) else 2
    sensor = replace(sensor, gate_m=(0.2, 0.2 + (bins - 0.5) * Bandwidth().bin_m), weight=1 / count)
    return DesignSpec("made-up", tuple(replace(sensor, name=f"s{index}") for index in range(count)))


def error_of(rays, sensors, bins):
    """A score that falls with everything that a design may have more of."""
    return 300 / rays + 40 / sensors + 60 / bins


class KnownScenes:
    """Scenes on which every design has its made-up error, and the same spread around it."""

    def __init__(self, spread=0.0, better="lower"):
        self.spread, self.sign = spread, 1 if better == "lower" else -1

    def scenes(self, count):
        return [SimpleNamespace(group=None)] * count

    def scores_in(self, number, lists, planned):
        ((rays,),) = lists
        bins = round(Bandwidth().mbps(rays) / len(rays) / ONE_BIN)
        error = error_of(len(rays), len(np.unique(rays.sensor)), bins)
        return [self.sign * (error + self.spread * (1 if number % 2 else -1))]


def search(run, goal, least, better="lower", spread=0.0, **options):
    """A search for a goal among made-up designs."""
    request = FitRequest.resolve(RunFolder.open(run), {"goal": abs(goal), "least": least, **options})
    found = GoalSearch(replace(request, goal=goal), made_up, KnownScenes(spread, better))
    found.metric = Metric("error", "mm", better, 500.0 if better == "lower" else -500.0, 0.0)
    return found


class TestTheSearch:
    @pytest.mark.parametrize("better", ["lower", "higher"])
    @settings(max_examples=10)
    @given(st.floats(25, 100))
    def test_returns_the_least_that_keeps_the_goal(self, made, better, goal):
        sign = 1 if better == "lower" else -1
        every = {
            "sensors": [(n, error_of(32, n, MOST_BINS)) for n in COUNTS],
            "rays": [(n, error_of(n, 2, MOST_BINS)) for n in range(2, 65)],
            "bandwidth": [
                (n * bins * ONE_BIN, error_of(n, 2, bins)) for n in (8, 16, 32, 64) for bins in range(1, MOST_BINS + 1)
            ],
        }
        for least, errors in every.items():
            sought = search(made, sign * goal, least, better, **({} if least == "sensors" else {"sensors": 2}))
            keeping = [cost for cost, error in errors if error <= goal]
            if not keeping:
                with pytest.raises(InfeasibleError):
                    sought.found(COUNTS)
                continue
            found = sought.found(COUNTS)
            assert min(keeping) <= found.cost * (1 + 1e-9) <= (1 + FINENESS) * min(keeping) * (1 + 1e-3)
            assert found.keeps
            assert not any(one.keeps for one in sought.tried if one.cost < found.cost)

    @pytest.mark.parametrize("spread", [10.0, 20.0])
    def test_wants_the_whole_interval_to_keep_the_goal(self, made, spread):
        found = search(made, 55, "sensors", spread=spread).found(COUNTS)
        assert found.score.high <= 55
        assert found.trial.sensors > search(made, 55, "sensors").found(COUNTS).trial.sensors

    def test_scores_a_design_on_more_scenes_until_it_is_clear(self, made):
        sought = search(made, 55, "sensors", spread=10.0)
        sought.found(COUNTS)
        for one in sought.tried:
            is_clear = not one.score.low <= 55 <= one.score.high
            assert is_clear or len(one.trial.scores) == 10
        assert len({len(one.trial.scores) for one in sought.tried}) == 2

    def test_that_fails_names_the_best_there_is(self, made):
        with pytest.raises(InfeasibleError, match="best that was tried is 64 rays of 2 sensors") as refused:
            search(made, 1, "bandwidth", sensors=2).found(COUNTS)
        assert refused.value.conflicts == ("--goal",)

    @given(st.floats(1e-6, 1e6))
    def test_asks_for_bandwidths_that_a_user_can_type(self, mbps):
        assert mbps <= rounded_up(mbps) <= 1.0011 * mbps
        assert float(f"{rounded_up(mbps):.4g}") == rounded_up(mbps)


class TestTheCommand:
    @pytest.mark.parametrize(
        ("least", "options"),
        [
            ("bandwidth", ("--sensors", 1, "--rays", 16, "--layout", "even")),
            ("rays", ("--sensors", 1, "--rays", 16)),
            ("sensors", ("--rays", 16)),
            ("parts", ("--parts", "vl53l8cx", "--sensors", 2)),
        ],
    )
    def test_writes_the_bytes_that_asking_for_what_was_found_gives(self, lidardesign, flat, least, options):
        done = lidardesign("fit", flat, *options, "--goal", 150, "--least", least, "--json", "-v")
        assert done.code == 0, done.err
        goal, path = done.json["goal"], flat / "designs" / "fit.yaml"
        assert (goal["value"], goal["least"]) == (150, least)
        assert goal["found"]["ci_high"] <= 150
        assert goal["found"] in goal["tried"]
        assert f"goal 150 mm, least {least}" in done.err
        written, found = path.read_bytes(), goal["found"]
        again = ("--parts", "vl53l8cx") if least == "parts" else ("--rays", found["rays"])
        again += ("--layout", "even") if "even" in options else ()
        limit = found["limit_mbps"]
        words = ("constrain", flat, "--set", f"budget.bandwidth_mbps={limit}") if limit else ("fit", flat)
        assert lidardesign(*words, *again, "--sensors", found["sensors"], "--name", "fit", "--quiet").code == 0
        assert path.read_bytes() == written
        assert bool(limit) == (least == "bandwidth")

    def test_ends_where_nothing_keeps_the_goal(self, lidardesign, flat):
        done = lidardesign("fit", flat, "--goal", 0, "--rays", 8, "--layout", "even", "--json")
        assert done.code == 4
        assert done.json["error"]["conflicts"] == ["--goal"]
        assert "8 rays" in done.json["error"]["message"]
        assert not (flat / "designs" / "fit.yaml").exists()
