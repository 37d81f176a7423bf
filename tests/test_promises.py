"""Promises that hold for all of the program: the same bytes, no NaN, nothing lost, errors of figures."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.command_line import files_under
from support.fits import fitted
from support.small_runs import shifted

from lidardesign.config import DensitySettings
from lidardesign.constraints.document import Constraints
from lidardesign.density.objective.target import build_target
from lidardesign.density.training.quality import coverage, quality
from lidardesign.errors import LidardesignError
from lidardesign.estimates import mean_interval
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Ambient, Body, Medium, Scene, Sphere, rigid
from lidardesign.scoring.scene_scores import checked_score
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.simulate.returns import simulate
from lidardesign.space import DesignSpace
from lidardesign.task import Score

FLATLAND = (
    "learn", "flatland", "--preset", "draft", "--seed", str(shifted(3)),
    *(word for setting in (
        "train=3", "test=2", "density.sigma_m=0.06",
        "learning.steps=40", "learning.batch=64", "learning.layers=1", "learning.hidden=16",
        "learning.samples=2000", "learning.balance_proposals=512", "learning.coverage_proposals=256",
        "learning.checkpoint_seconds=0.001",
    ) for word in ("--set", setting)),
)  # fmt: skip
BYTES = ("flow.safetensors", "samples.npz")
EVEN = ("--layout", "even", "--sensors", "2")


def strict(text):
    """A JSON document; NaN and Infinity, which are no JSON, fail."""

    def refuse(word):
        raise AssertionError(f"{word} in the document")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.hard_case(
    "P1",
    "The same seed, versions and machine",
    done="the same bytes of flow, samples, designs and exports, in any process",
)
class TestTheSameBytes:
    @staticmethod
    def chain(lidardesign, run):
        """All files of learning, fitting, constraining and exporting but times, and the scores."""
        assert lidardesign(*FLATLAND, "--out", run).code == 0
        assert lidardesign("fit", run, "--sensors", 2, "--rays", 20).code == 0
        tight = ("--set", "gate.width_m.max=0.4", "--name", "tight")
        assert lidardesign("constrain", f"{run}/designs/fit.yaml", *tight).code == 0
        assert lidardesign("export", f"{run}/designs/tight.yaml", "--format", "csv", "--rays", 20).code == 0
        rows = lidardesign("evaluate", run, "--rays", 20, "--baseline", "random", "--json").json["rows"]
        files = files_under(Path(run))
        kept = {name: files[name] for name in files if name in BYTES or name.startswith("designs/")}
        return kept, [{**row, "seconds": None} for row in rows]

    def test_the_whole_chain_twice_gives_the_same_files_and_scores(self, lidardesign, tmp_path):
        (tmp_path / "a").mkdir()
        (tmp_path / "b").mkdir()
        first, second = (self.chain(lidardesign, f"{folder}/run") for folder in "ab")
        assert len(first[0]) >= 5
        assert first == second

    def test_another_process_with_another_hash_seed_and_more_threads_writes_the_same_design(self, lidardesign, flat):
        assert lidardesign("fit", flat, *EVEN, "--name", "here").code == 0
        environment = {**os.environ, "PYTHONHASHSEED": "12345", "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
        command = [sys.executable, "-m", "lidardesign", "fit", str(flat), *EVEN, "--name", "there"]
        subprocess.run(command, env=environment, check=True, capture_output=True)
        here, there = ((flat / "designs" / f"{name}.yaml").read_text() for name in ("here", "there"))
        assert here.replace("here", "there") == there


BALL = Scene((Body(Sphere(0.5), poses=rigid(translation_m=(1.5, 0, 0))),))
SPACE = DesignSpace((0, 0, 0, -0.4, -0.4, 0.2), (0, 0, 0, 0.4, 0.4, 2.5))


def target():
    return build_target([BALL], SPACE, DensitySettings(sigma_m=0.05), "raycast")


def samples_with(value, name):
    points = SPACE.sample(500, np.random.default_rng(0))
    arrays = {"points": points, "log_prob": np.zeros(500), "log_target": np.zeros(500)}
    arrays[name][7] = value
    return Samples(**arrays, space=SPACE)


def rays_with(value, name):
    arrays = {
        "origin_m": np.zeros((2, 3)), "direction": np.tile([1.0, 0, 0], (2, 1)), "gate_m": np.tile([0.1, 2.0], (2, 1)),
        "sensor": np.zeros(2), "time_s": np.zeros(2),
    }  # fmt: skip
    arrays[name].flat[0] = value
    return Rays(**arrays)


ERROR = SimpleNamespace(name="error", worst=1.0, better="lower")


def scoring(value):
    """A task whose score is a value."""
    return SimpleNamespace(name="case", score=lambda scene, returns: Score(value))


def poses_with(value):
    pose = rigid(translation_m=(1, 0, 0))
    pose[0, 3] = value
    return pose


# public function -> a call that is given a number which is none
GIVEN = {
    "DesignSpace": lambda x: DesignSpace((x, 0, 0, 0, 0, 0), (1, 1, 1, 1, 1, 1)),
    "Body.poses": lambda x: Body(Sphere(1.0), poses=poses_with(x)),
    "Medium": lambda x: Medium(x, 0.1),
    "Ambient": lambda x: Ambient(illuminance_lux=x),
    "Rays.origin_m": lambda x: rays_with(x, "origin_m"),
    "Rays.direction": lambda x: rays_with(x, "direction"),
    "Rays.gate_m": lambda x: rays_with(x, "gate_m"),
    "Rays.time_s": lambda x: rays_with(x, "time_s"),
    "Target.log_density": lambda x: target().log_density(np.array([[0, 0, 0, x, 0, 1.0]])),
    "Target.log_density_and_gradient": lambda x: target().log_density_and_gradient(np.array([[0, 0, 0, 0, 0, x]])),
    "quality": lambda x: quality(np.zeros(3), np.array([0, x, 0])),
    "Samples.weights": lambda x: samples_with(abs(x), "log_target").weights,
    "fit_sensors, points": lambda x: fitted(samples_with(x, "points"), sensors=1),
    "fit_sensors, log_prob": lambda x: fitted(samples_with(x, "log_prob"), sensors=1),
    "split_budget": lambda x: split_budget([1.0, x], 10),
    "Constraints": lambda x: Constraints.from_mapping({"gate": {"width_m": {"max": x}}}),
    "mean_interval": lambda x: mean_interval([1.0, x]),
    "checked_score": lambda x: checked_score(scoring(x), ERROR, BALL, simulate(BALL, rays_with(0.0, "origin_m"))),
}


@pytest.mark.hard_case(
    "P2",
    "A public function is given numbers that are none, or comes to one",
    done="it raises an error that says where, or gives a defined value with a status",
)
class TestNoNaNLeaves:
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    @pytest.mark.parametrize("name", GIVEN)
    def test_what_is_no_number_is_refused_by_name(self, name, value):
        with pytest.raises(LidardesignError) as refused:
            GIVEN[name](value)
        assert len(str(refused.value)) > 20

    # (d / sigma)^2 / 2 with lengths below 1e9 m over spreads above 1e-15 m stays far below 1e100
    @given(st.lists(st.floats(-1e100, 1e100), min_size=1, max_size=8), st.floats(-1e100, 1e100))
    def test_figures_of_any_finite_weights_are_finite(self, log_weights, offset):
        log_target = np.array(log_weights)
        found = quality(np.full(len(log_target), offset), log_target)
        assert all(math.isfinite(number) for one in found.values() for number in (one.value, one.error))
        covered = coverage(
            np.zeros(len(log_target)), log_target, np.full(len(log_target), offset), found["log_z"].value
        )
        assert 0 <= covered.value <= 1

    def test_every_number_that_the_commands_print_is_finite(self, lidardesign, flat):
        made = [
            lidardesign("fit", flat, *EVEN, "--name", "one", "--json"),
            lidardesign("constrain", flat, "--set", "budget.rays=9", "--sensors", 2, "--name", "two", "--json"),
            lidardesign("show", flat / "designs" / "two.yaml", "--json"),
            lidardesign("export", flat / "designs" / "two.yaml", "--format", "csv", "--json"),
            lidardesign("evaluate", flat, "--rays", 9, "--set", "test=2", "--json"),
            lidardesign("tasks", "list", "--json"),
            lidardesign("tasks", "show", "flatland", "--json"),
        ]
        for done in made:
            assert done.code == 0, done.err
            assert strict(done.out)


# figures that are exact by what they are: counts, bounds and settings that were asked for, times that were measured
FIGURES = {
    "learn": {"ess", "kl_nats", "log_z", "coverage", "misplaced"},
    "fit": {"log_likelihood", "ess", "admissible_mass"},
}
KINDS = {"standard error", "half of the 95 % interval", "rounding"}


@pytest.mark.hard_case(
    "P6",
    "A figure is reported",
    done="every estimate has its unit, its method and its error in `error_estimates`",
)
class TestEveryFigureHasItsError:
    @staticmethod
    def complete(estimate):
        assert set(estimate) == {"value", "error", "unit", "kind"}
        assert estimate["kind"] in KINDS
        assert isinstance(estimate["unit"], str)
        assert estimate["error"] is None or estimate["error"] >= 0

    def test_what_learning_reports_has_unit_method_and_error(self, lidardesign):
        document = lidardesign(*FLATLAND, "--out", "run", "--json").json
        estimates = document["error_estimates"]
        assert set(estimates) == FIGURES["learn"]
        for name, estimate in estimates.items():
            self.complete(estimate)
            assert estimate["value"] == document[name]
            assert estimate["error"] is not None
            assert (estimate["unit"] == "nats") == (name in ("kl_nats", "log_z"))

    def test_what_fits_report_has_unit_method_and_error(self, lidardesign, flat):
        region = ("--set", "origin.spread_m.max=0.2")  # the share of the density inside is known of regions alone
        document = lidardesign("constrain", flat, *EVEN, *region, "--rays", 20, "--json").json
        assert set(document["error_estimates"]) >= FIGURES["fit"]
        for name, estimate in document["error_estimates"].items():
            self.complete(estimate)
            if name in document and estimate["value"] is not None:
                assert estimate["value"] == pytest.approx(document[name])
        for check in document["constraints"]:
            assert {"name", "bound", "value", "satisfied"} == set(check)

    def test_every_score_and_every_difference_has_unit_method_and_error(self, lidardesign, flat):
        assert lidardesign("fit", flat, *EVEN, "--name", "one").code == 0
        document = lidardesign("evaluate", flat, "--rays", 8, "--rays", 12, "--set", "test=4", "--json").json
        estimates, unit = document["error_estimates"], document["metric"]["unit"]
        for row in document["rows"]:
            assert row["ci_low"] <= row["value"] <= row["ci_high"]
            if row["design"] == "one":
                self.complete(estimates[f"one at {row['rays']} rays"])
        pairs = [pair for pair in document["paired"] if pair["a"] == "one"]
        assert pairs
        for pair in pairs:
            estimate = estimates[f"one - {pair['b']} at {pair['rays']} rays"]
            self.complete(estimate)
            assert estimate["unit"] == unit
            assert estimate["error"] == pair["half_width"]

    def test_tables_print_errors_and_units_beside_the_figures(self, lidardesign, flat):
        assert "+-" in lidardesign("fit", flat, *EVEN, "--name", "one", "-v").out
        table = lidardesign("evaluate", flat, "--rays", 8, "--set", "test=4").out
        assert "mm" in table
        assert "95 %" in table
