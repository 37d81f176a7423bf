"""What a fit is where nobody says so: which layout, how many sensors, and what is said of those that were tried."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import make_run
from support.sensors import normal_sensor

from lidardesign.api.run import open_run
from lidardesign.choices.fit import BEST
from lidardesign.errors import ConfigError, InfeasibleError
from lidardesign.fitting import request as requests
from lidardesign.fitting import trials as tried
from lidardesign.fitting.request import CHOSEN_LEVEL, FitRequest
from lidardesign.run_folder import RunFolder
from lidardesign.sensors.design import DesignSpec
from lidardesign.task import Metric

MOUNTS = {"origin": {"mounts_m": [[0.2, 0, 0], [0.8, 0, 0]]}}


def resolved(run, base=None, **options):
    return FitRequest.resolve(RunFolder.open(run), options, base)


class TestWhatIsLeftOpen:
    @pytest.mark.parametrize(
        ("options", "expected"),
        [
            ({}, {"layout": "chosen", "sensors": BEST, "level": CHOSEN_LEVEL, "counts": [8, 16, 32, 64]}),
            ({"rays": 9}, {"counts": [9]}),
            ({"level": 0.8}, {"layout": "chosen", "level": 0.8}),
            ({"constraints": {"gate": {"width_m": {"max": 0.3}}}}, {"layout": "chosen", "sensors": BEST}),
            ({"constraints": {"sensors": {"min": 2, "max": 3}}}, {"layout": "chosen", "sensors": BEST}),
            ({"constraints": {"sensors": {"count": 3}}}, {"layout": "chosen", "sensors": 3}),
            ({"constraints": MOUNTS}, {"layout": "chosen", "sensors": None}),
            ({"constraints": {**MOUNTS, "sensors": {"count": 1}}}, {"layout": "chosen", "sensors": 1}),
            ({"constraints": {"parts": {"names": "catalog", "count": 2}}}, {"layout": "even", "sensors": 2}),
            ({"parts": ["vl53l8cx"], "sensors": 3}, {"layout": "even", "sensors": 3}),
            ({"weights": ["variation=0.5"]}, {"layout": "chosen", "sensors": BEST}),
            ({"layout": "even"}, {"sensors": BEST, "level": 0.95, "counts": [8, 16, 32, 64]}),
            ({"layout": "spinning"}, {"sensors": 1}),
            ({"sensors": 2}, {"layout": "chosen", "sensors": 2}),
        ],
    )
    def test_follows_from_what_is_asked_for(self, made, options, expected):
        request = resolved(made, **options)
        assert {name: getattr(request, name) for name in expected} == expected

    @pytest.mark.parametrize(("at", "gates"), [({}, "ray"), ({"x_m": 0.5}, "sensor")])
    def test_rays_that_follow_a_condition_have_gates_of_their_own(self, tmp_path, at, gates):
        request = resolved(make_run(tmp_path / "aisle", count=1000, task="warehouse"), at=at)
        assert (request.layout, request.gates) == ("chosen", gates)

    def test_a_task_that_does_not_say_what_returns_tell_has_even_rays(self, made, monkeypatch):
        monkeypatch.setattr(requests, "informs_rays", lambda task: False)
        assert resolved(made).layout == "even"

    @pytest.mark.parametrize("layout", ["even", "chosen", "spinning"])
    def test_is_the_designs_where_one_is_fitted_again(self, made, layout):
        channels = {"channels": 1} if layout == "spinning" else {"level": 0.9}
        base = open_run(made).fit(layout=layout, sensors=2, rays=12, **channels).specification
        again = resolved(made, base)
        assert (again.layout, again.sensors, again.rays) == (layout, 2, 12)
        assert (again.channels, again.level) == ((1, again.level) if layout == "spinning" else (None, 0.9))
        assert resolved(made, replace(base, level=0.8), layout="even" if layout == "chosen" else "chosen").level == 0.8
        assert resolved(made, base, constraints={"sensors": {"min": 3}}).sensors == 3
        assert resolved(made, base, constraints={"sensors": {"max": 1}}).sensors == 1


# What excludes each other or cannot be: options, and the argument that is named.
REFUSED = [
    ({"layout": "even", "gates": "ray"}, "gates"),
    ({"layout": "spinning", "gates": "ray"}, "gates"),
    ({"channels": 4}, "channels"),
    ({"layout": "even", "channels": 4}, "channels"),
    ({"layout": "spinning", "sensors": BEST}, "sensors"),
    ({"layout": "spinning", "weights": ["variation=0.5"]}, "layout"),
    ({"parts": ["vl53l8cx"]}, "parts"),
    ({"parts": ["vl53l8cx"], "sensors": BEST}, "parts"),
    ({"parts": ["vl53l8cx"], "sensors": 1, "layout": "even"}, "parts"),
    ({"parts": ["vl53l8cx"], "sensors": 1, "gates": "sensor"}, "parts"),
    ({"parts": ["vl53l8cx"], "sensors": 1, "weights": ["variation=0.5"]}, "parts"),
    *(({"goal": goal}, "goal") for goal in (math.nan, math.inf, -1, 501, True, "6")),
    ({"least": "rays"}, "least"),
    ({"goal": 100, "least": "weight"}, "least"),
    ({"goal": 100, "least": "parts"}, "least"),
    ({"goal": 100, "least": "rays", "parts": ["vl53l8cx"], "sensors": 2}, "least"),
    ({"goal": 100, "least": "sensors", "sensors": 2}, "sensors"),
    ({"goal": 100, "layout": "spinning"}, "goal"),
    ({"survive": 1, "sensors": 1}, "survive"),
    ({"survive": 1, "constraints": {"sensors": {"max": 1}}}, "survive"),
    ({"survive": 1, "sensors": 3, "layout": "even"}, "survive"),
    ({"survive": 1, "sensors": 3, "layout": "spinning"}, "survive"),
    ({"survive": 1, "sensors": 3, "parts": "catalog"}, "survive"),
    ({"adaptive": 2, "layout": "even"}, "adaptive"),
    ({"adaptive": 2, "layout": "spinning", "sensors": 1}, "adaptive"),
    ({"adaptive": 2, "parts": ["vl53l5cx"], "sensors": 1}, "adaptive"),
    ({"adaptive": 2, "sensors": 2, "survive": 1}, "adaptive"),
    ({"adaptive": 2, "goal": 20}, "adaptive"),
    ({"adaptive": 0}, "adaptive"),
    ({"adaptive": 65}, "adaptive"),
]


@pytest.mark.parametrize(("options", "argument"), REFUSED)
def test_options_that_exclude_each_other_or_cannot_be_are_refused_by_name(made, options, argument):
    with pytest.raises(ConfigError) as refused:
        open_run(made).fit(**options)
    assert refused.value.where.split()[0] == argument


@pytest.fixture(scope="module")
def trying(made):
    """Which numbers of sensors are tried, where some of them are infeasible."""
    some = DesignSpec("some", (normal_sensor(origin_m=(0.5, 0, 0), azimuth_rad=1.6, range_m=0.7),))

    def found(infeasible=(), **options):
        asked = []

        def fitted(request):
            asked.append(request.sensors)
            if asked[-1] in infeasible:
                raise InfeasibleError(f"not {asked[-1]}", conflicts=["sensors.count"])
            return some

        trials = tried.trials_of(resolved(made, rays=8, **options), fitted, (1, 2, 3, 4, 6, 8))
        return SimpleNamespace(asked=asked, trials=trials)

    return found


class TestNumbersOfSensorsThatAreTried:
    @pytest.mark.parametrize(
        ("rules", "counts"),
        [
            ({}, [1, 2, 3, 4, 6, 8]),
            ({"sensors": {"min": 3}}, [3, 4, 6, 8]),
            ({"sensors": {"max": 2}}, [1, 2]),
            ({"sensors": {"min": 5, "max": 7}}, [6]),
            ({"sensors": {"min": 5, "max": 5}}, [5]),
            ({"sensors": {"min": 9}}, [9]),
            ({"each": [{}, {"gate": {"width_m": {"max": 0.5}}}]}, [2, 3, 4, 6, 8]),
            ({"each": [{}, {}, {}], "sensors": {"max": 4}}, [3, 4]),
        ],
    )
    def test_are_those_that_constraints_allow(self, trying, rules, counts):
        assert trying(constraints=rules).asked == counts

    @pytest.mark.parametrize("infeasible", [(1,), (2, 4), (6, 8), (1, 2, 3, 4, 6)])
    def test_that_cannot_be_are_passed_over(self, trying, infeasible):
        found = trying(infeasible)
        assert found.asked == [1, 2, 3, 4, 6, 8]
        assert len(found.trials) == len(found.asked) - len(infeasible)

    def test_of_which_none_can_be_end_with_the_error_of_the_fewest(self, trying):
        with pytest.raises(InfeasibleError, match="not 2"):
            trying((2, 3, 4, 6, 8), constraints={"sensors": {"min": 2}})


SCENES = [SimpleNamespace(group=None)] * 4


class Known(tried.Trial):
    """A trial of which all scores are known beforehand."""

    mbps = 1.0


def trial(sensors, *scores, mbps=1.0):
    # what it fires are its scores
    found = Known(sensors, tuple(map(float, scores)))
    found.mbps = mbps
    return found


class Repeated:
    """Scenes that repeat as often as they are asked for, with the scores that trials have on them."""

    def __init__(self, scenes):
        self.few = list(scenes)

    def scenes(self, count):
        return [self.few[number % len(self.few)] for number in range(count)]

    def scores_in(self, number, lists, planned):
        return [scores[number % len(self.few)] for scores in lists]


def best_of(trials, scenes, better="lower", worst=100.0, most=4, **price):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tried, "FEW_SCENES", len(scenes))
        patch.setattr(tried, "MOST_SCENES", most)
        for one in trials:
            one.scores = np.zeros(0)
        return tried.best_of(trials, Repeated(scenes), Metric("error", "mm", better, worst, 0.0), **price)


class TestTheBestNumber:
    def test_has_the_lowest_scores(self):
        assert best_of([trial(1, 5, 6, 7, 8), trial(2, 1, 2, 3, 4), trial(4, 3, 4, 5, 6)], SCENES).sensors == 2

    @given(st.permutations([1.0, 2.0, 3.0, 4.0]), st.integers(2, 4))
    def test_is_the_fewest_among_equals(self, scores, equals):
        assert best_of([trial(n + 1, *scores) for n in range(equals)], SCENES).sensors == 1

    def test_is_fewer_where_more_gain_less_than_their_standard_error(self):
        # lost: -1, 1, -1, 2 with the mean 0.25 and the standard error 0.75
        few, more = trial(1, 4, 6, 4, 7), trial(2, 5, 5, 5, 5)
        assert best_of([few, more], SCENES).sensors == 1
        # the same mean loss on every scene counts
        assert best_of([trial(1, 5.25, 5.25, 5.25, 5.25), more], SCENES).sensors == 2

    def test_counts_scenes_of_a_group_once(self):
        together = [SimpleNamespace(group=name) for name in ("other", "one", "one", "one")]
        few, more = trial(1, 4, 7, 7, 7), trial(2, 5, 5, 5, 5)
        assert best_of([few, more], SCENES).sensors == 2
        assert best_of([few, more], together).sensors == 1

    @pytest.mark.parametrize(("better", "worst"), [("lower", 20.0), ("higher", 0.0)])
    def test_takes_less_bandwidth_where_more_brings_little(self, better, worst):
        # ten percent more for one percent better, and for four percent
        for gained, sensors in ((0.1, 2), (0.4, 1)):
            best = 10 - gained if better == "lower" else 10 + gained
            trials = [trial(1, *4 * [best], mbps=1.1), trial(2, *4 * [10], mbps=1.0)]
            assert best_of(trials, SCENES, better, worst).sensors == sensors

    def test_takes_any_bandwidth_for_a_design_that_never_errs(self):
        assert best_of([trial(1, 0, 0, 0, 0, mbps=100.0), trial(2, 1, 1, 1, 1)], SCENES).sensors == 1

    def test_is_judged_on_more_scenes_while_it_is_not_clear_and_never_again_where_it_lost(self):
        # a hundred times as many scenes make the loss of 0.25 clear
        few, more, lost = trial(1, 4, 6, 4, 7), trial(2, 5, 5, 5, 5), trial(3, 9, 9, 9, 9)
        assert best_of([few, more, lost], SCENES, most=400).sensors == 2
        assert len(few.scores) == len(more.scores) > len(lost.scores) == 4

    @given(st.lists(st.floats(1, 9), min_size=4, max_size=4))
    def test_without_a_price_has_the_best_mean_in_any_bandwidth(self, scores):
        few, more = trial(1, *scores), trial(2, 1, 9, 5, 4, mbps=100.0)
        wanted = 1 if np.mean(scores) <= 4.75 else 2
        assert best_of([few, more], SCENES, price=None).sensors == wanted

    def test_of_a_single_scene_is_the_lowest(self):
        assert best_of([trial(1, 5), trial(2, 4)], SCENES[:1]).sensors == 2


class TestTheCommand:
    def test_says_what_was_tried_and_writes_the_bytes_that_the_number_gives_by_itself(self, lidardesign, flat):
        done = lidardesign("fit", flat, "--rays", 9, "--json", "-v")
        assert done.code == 0, done.err
        said, count = " ".join(done.err.split()), len(done.json["sensors"])
        assert f"sensors: {count}; Chamfer distance [mm] on 5 training scenes by their number: 1: " in said
        path = flat / "designs" / "fit.yaml"
        written = path.read_bytes()
        assert lidardesign("fit", flat, "--rays", 9, "--sensors", count, "--quiet").code == 0
        assert path.read_bytes() == written

    def test_tries_nothing_where_the_number_is_given(self, lidardesign, flat, monkeypatch):
        def never(*_):
            raise AssertionError("numbers of sensors were tried")

        monkeypatch.setattr(tried, "trials_of", never)
        for options in (("--sensors", 1), ("--set", "sensors.count=1"), ("--layout", "spinning", "--channels", 1)):
            command = "constrain" if "--set" in options else "fit"
            done = lidardesign(command, flat, *options, "--rays", 4)
            assert done.code == 0, done.err
            assert "sensors:" not in done.err

    def test_refuses_contradictions_before_any_scene_is_drawn(self, lidardesign, flat, monkeypatch):
        def never(*_):
            raise AssertionError("scenes were drawn")

        monkeypatch.setattr(RunFolder, "scenes", never)
        done = lidardesign("constrain", flat, "--set", "gate.start_m.min=0.8", "--set", "gate.end_m.max=0.5", "--json")
        assert done.code == 4
        assert set(done.json["error"]["conflicts"]) == {"gate.start_m.min", "gate.end_m.max"}
