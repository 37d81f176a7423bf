"""Learning the flow: edges, float32, steps that are not finite, separated modes, targets without shape."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import references
from support.flows import FLOWS, draw, flow_of
from support.learning import SPACE, BallTask, Interrupter, a_trainer, begun, config_of, learn, result_bytes
from support.spaces import log_volume

from lidardesign.config import DensitySettings
from lidardesign.density.network import BoundedSpline
from lidardesign.density.objective.proposals import independent_samples
from lidardesign.density.objective.target import Target
from lidardesign.density.training import quality as measure
from lidardesign.density.training import trainer as training
from lidardesign.density.training.checkpoint import load_arrays
from lidardesign.density.training.learn import make_trainer, prepare_training_data
from lidardesign.density.training.losses import TOLERANCE_NATS, round_trip_nats
from lidardesign.errors import DivergenceError
from lidardesign.samples import load_samples
from lidardesign.scenes.scene import Body, Scene, Sphere, rigid
from lidardesign.space import DesignSpace


def interrupted(run, step, **options):
    with pytest.raises(KeyboardInterrupt):
        learn(BallTask(), config_of(), run, progress=Interrupter(step), **options)


@pytest.mark.hard_case(
    "23",
    "Points at or over the edge of the flow's box, knots beyond its bound, infinite and NaN inputs",
    done="points are kept inside, where densities are finite",
)
class TestEdgesOfTheBox:
    @pytest.mark.parametrize("name", FLOWS)
    def test_edges_are_finite_and_only_the_outside_has_no_density(self, name):
        flow = flow_of(name)
        _, context = draw(flow, 2)
        for edge in (-1.0, 1.0, math.nextafter(1.0, 0.0)):
            points = torch.full((2, flow.features), edge, dtype=torch.float64, requires_grad=True)
            for part in (flow.log_prob(points, context), *flow(points, context)):
                assert torch.isfinite(part).all()
                assert torch.isfinite(torch.autograd.grad(part.sum(), points, retain_graph=True)[0]).all()
        for outside in (1.0000001, -2.0, math.inf, -math.inf, math.nan):
            points = torch.zeros(2, flow.features, dtype=torch.float64)
            points[0, -1] = outside
            with torch.no_grad():
                found = flow.log_prob(points, context)
            assert found[0] == -math.inf
            assert torch.isfinite(found[1])

    @given(st.integers(0, 2**31), st.floats(0.0, 100.0), st.sampled_from(["float32", "float64"]))
    def test_the_last_knots_are_the_bounds_and_points_never_leave_them(self, seed, scale, dtype):
        generator, dtype = torch.Generator().manual_seed(seed), getattr(torch, dtype)
        sizes = [scale * torch.randn(20, 2, n, generator=generator, dtype=dtype) for n in (8, 8, 9)]
        made = BoundedSpline(*sizes, torch.tensor([False, True]))
        assert (made.horizontal[..., -1] == 1).all()
        assert (made.vertical[..., -1] == 1).all()
        for edge in (-1.0, 1.0):
            x = torch.full((20, 2), edge, dtype=dtype)
            for there in (made(x), made.inv(x)):
                assert (there.abs() <= 1).all()


@pytest.mark.hard_case(
    "24",
    "Parameters of the flow grow until float32 cannot invert its splines",
    done="discriminants are kept positive and splines evaluated in float64",
)
class TestSteepSplines:
    @given(st.sampled_from(sorted(FLOWS)), st.integers(0, 2**31), st.floats(0.0, 4.0))
    def test_there_and_back_is_exact_in_float64_for_any_weights_that_are_not_steep(self, name, seed, scale):
        flow = flow_of(name, scale=scale, seed=seed)
        base, context = draw(flow, 50, seed=seed)
        with torch.no_grad():
            values, log_prob = flow(base, context)
            again = flow.log_prob(values, context)
        assert values.abs().max() <= 1
        np.testing.assert_allclose(again.numpy(), log_prob.numpy(), atol=references.FLOW_ROUND_TRIP_NATS)

    def test_the_round_trip_tells_a_flow_that_float32_inverts_from_one_that_it_does_not(self):
        generator = torch.Generator().manual_seed(4)
        mild, steep = flow_of("all six").float(), flow_of("all six", layers=2, scale=10.0)
        assert round_trip_nats(mild, 500, generator) < 0.1 * TOLERANCE_NATS
        assert round_trip_nats(steep.float(), 500, generator) > 100 * TOLERANCE_NATS
        assert round_trip_nats(steep.double(), 500, generator) < TOLERANCE_NATS

    def test_a_round_trip_that_is_not_finite_is_infinitely_long(self):
        flow = flow_of("one dimension")
        with torch.no_grad():
            next(flow.parameters()).fill_(math.nan)
        assert round_trip_nats(flow, 10, torch.Generator().manual_seed(0)) == math.inf

    def test_steps_go_on_in_float64_where_float32_fails_and_not_before(self, tmp_path):
        trainer = a_trainer(tmp_path)
        trainer._advance()
        trainer.step = trainer.settings.pathwise_steps
        trainer._begin_stretch()
        assert trainer.doubled_at is None
        with torch.no_grad():
            for parameter in trainer.flow.parameters():
                parameter.mul_(50.0)
        trainer.step = 0
        trainer._begin_stretch()  # no foreign density is asked for yet
        assert trainer.doubled_at is None
        trainer.step = trainer.settings.pathwise_steps
        trainer._begin_stretch()
        assert trainer.doubled_at == trainer.settings.pathwise_steps
        state = [v for one in trainer.optimiser.state.values() for n, v in one.items() if n != "step"]
        assert {p.dtype for p in trainer.flow.parameters()} == {v.dtype for v in state} == {torch.float64}
        trainer._advance()
        assert all(torch.isfinite(p).all() for p in trainer.flow.parameters())

    def test_a_run_that_changed_to_float64_says_so_and_resumes_to_the_same_bytes(self, tmp_path, monkeypatch):
        monkeypatch.setattr(training, "TOLERANCE_NATS", 0.0)
        (tmp_path / "straight").mkdir()
        result = learn(BallTask(), config_of(), tmp_path / "straight")
        assert any("float64 was used from step 50 on" in note for note in result.notes)
        run = tmp_path / "stopped"
        run.mkdir()
        interrupted(run, 70)
        interrupted(run, 110, resume=True)  # before and after the first checkpoint in float64
        learn(BallTask(), config_of(), run, resume=True)
        assert result_bytes(run) == result_bytes(tmp_path / "straight")

    def test_the_round_trip_of_a_learned_flow_is_recorded_and_noted_where_it_is_long(self, tmp_path, monkeypatch):
        result = learn(BallTask(), config_of(), tmp_path)
        recorded = json.loads((tmp_path / "manifest.json").read_text())["round_trip_nats"]
        assert 0 <= recorded < references.FLOW_ROUND_TRIP_NATS
        assert not any("off by" in note for note in result.notes)
        monkeypatch.setattr(measure, "round_trip_nats", lambda *_: 0.5)
        (tmp_path / "steep").mkdir()
        result = learn(BallTask(), config_of(), tmp_path / "steep")
        assert any("log densities are off by up to 0.5 nats" in note for note in result.notes)


@pytest.mark.hard_case(
    "25",
    "A loss or a gradient of a step is NaN or infinite",
    done="the step is skipped and counted",
)
class TestStepsThatAreNotFinite:
    @staticmethod
    def broken_between(monkeypatch, first, last, factor=math.nan):
        """Gradients of the target that are no numbers at some of its evaluations, which are counted."""
        exact, calls = Target.log_density_and_gradient, {"n": 0}

        def flaky(self, points, sigma_m=None):
            values, gradient = exact(self, points, sigma_m)
            calls["n"] += 1
            return values, np.full_like(gradient, factor) if first < calls["n"] <= last else gradient

        monkeypatch.setattr(Target, "log_density_and_gradient", flaky)
        return calls

    @pytest.mark.parametrize("factor", [math.nan, math.inf, -math.inf])
    def test_a_skipped_step_leaves_weights_and_moments_alone(self, tmp_path, monkeypatch, factor):
        trainer = a_trainer(tmp_path)
        trainer._advance()
        before = trainer._state_arrays()
        self.broken_between(monkeypatch, 0, 1, factor)
        trainer._advance()
        after = trainer._state_arrays()
        assert trainer.skipped == 1
        for name in before.keys() - {"generator"}:
            np.testing.assert_array_equal(after[name], before[name])

    def test_five_in_a_row_take_the_last_good_weights_back_and_halve_the_step_size(self, tmp_path, monkeypatch):
        self.broken_between(monkeypatch, 54, 59)
        learn(BallTask(), config_of(), tmp_path)
        rows = {row["step"]: row for row in map(json.loads, (tmp_path / "progress.jsonl").read_text().splitlines())}
        (tmp_path / "plain").mkdir()
        monkeypatch.undo()
        learn(BallTask(), config_of(), tmp_path / "plain")
        plain = [json.loads(line) for line in (tmp_path / "plain" / "progress.jsonl").read_text().splitlines()]
        for row in plain:
            halved = 2.0 if row["step"] > 50 else 1.0
            assert rows[row["step"]]["rate"] == pytest.approx(row["rate"] / halved)
        assert rows[120]["skipped"] == 5

    def test_gradients_that_stay_nan_end_in_a_divergence_error_with_a_readable_checkpoint(self, tmp_path, monkeypatch):
        self.broken_between(monkeypatch, 0, math.inf)
        match = r"(?s)non-finite.*checkpoint\.safetensors.*learning\.rate"
        with pytest.raises(DivergenceError, match=match) as caught:
            learn(BallTask(), config_of(), tmp_path)
        assert caught.value.exit_code == 5
        arrays, state = load_arrays(tmp_path, training.CHECKPOINT)
        assert state["step"] % training.STRETCH == 0
        assert all(np.isfinite(value).all() for value in arrays.values() if value.dtype.kind == "f")

    def test_a_resume_after_steps_were_skipped_is_bit_identical_too(self, tmp_path, monkeypatch):
        # a whole stretch of steps after the snapshot at step 50 has no gradient, so weights are taken back
        calls = self.broken_between(monkeypatch, 54, 62)
        (tmp_path / "straight").mkdir()
        result = learn(BallTask(), config_of(), tmp_path / "straight")
        assert any("8 steps were skipped" in note for note in result.notes)
        assert math.isfinite(result.kl_nats)
        calls["n"] = 0
        (tmp_path / "resumed").mkdir()
        interrupted(tmp_path / "resumed", 60)
        calls["n"] = 50  # the resumed run starts at the snapshot of step 50
        learn(BallTask(), config_of(), tmp_path / "resumed", resume=True)
        assert result_bytes(tmp_path / "resumed") == result_bytes(tmp_path / "straight")


LEFT, RIGHT = -0.9, 0.9
WIDE = DesignSpace((0, 0, 0, -1.2, 0, 0.5), (0, 0, 0, 1.2, 0, 2.5))
LONGER = {"steps": 250, "batch": 256, "layers": 2, "hidden": 32, "samples": 8000, "checkpoint_seconds": 100.0}


class BallsTask(BallTask):
    """Balls of 5 cm, 1.5 m away at azimuths."""

    def __init__(self, *azimuths):
        self.azimuths = azimuths

    def scenes(self, config, split, seed):
        places = [1.5 * np.array([math.cos(a), math.sin(a), 0]) for a in self.azimuths]
        return [
            Scene(tuple(Body(Sphere(0.05), f"ball {i}", poses=rigid(translation_m=p)) for i, p in enumerate(places)))
        ]


def trainer_of(task, space, run, **settings):
    config = config_of(space, **settings)
    data = prepare_training_data(task, config)
    return make_trainer(data, config, begun(run), torch.device("cpu")), data, config


@pytest.mark.hard_case(
    "26",
    "A target of modes far apart, of which the reverse KL drops some",
    done="sigma is annealed from six times its value and most steps balance by independent proposals",
)
class TestModesFarApart:
    def test_both_modes_are_learned_with_the_settings_that_stand(self, tmp_path):
        result = learn(BallsTask(LEFT, RIGHT), config_of(WIDE, **LONGER), tmp_path)
        left = load_samples(tmp_path)
        share = float(left.weights[left.points[:, 3] < 0].sum())
        own = float((left.points[:, 3] < 0).mean())
        # both balls look alike from the middle
        assert share == pytest.approx(0.5, abs=0.1)
        # a short training leaves them unlike, and says so by the weights
        assert 0.1 < own < 0.9
        assert result.coverage > 0.9
        assert result.ess > 0.2

    def test_a_dropped_mode_is_told_by_the_coverage_whatever_the_ess_says(self, tmp_path):
        # learned for the left ball, judged for both
        one, _, _ = trainer_of(BallsTask(LEFT), WIDE, tmp_path, **LONGER)
        one.train()
        _, both, _ = trainer_of(BallsTask(LEFT, RIGHT), WIDE, tmp_path, **LONGER)
        judged = SimpleNamespace(
            flow=one.flow.double(), target=both.target, coordinates=one.coordinates, generator=one.generator
        )
        probes = independent_samples(both.target, 2000, np.random.default_rng(1))
        found = measure.measure(judged, probes, 4000).estimates
        assert found["coverage"].value == pytest.approx(0.5, abs=0.1)
        assert found["misplaced"].value > 0.4


@pytest.mark.hard_case(
    "27",
    "A target that is next to a point or constant, a single scene, a single free dimension",
    done="all of them are learned, with finite figures that agree with the closed forms",
)
class TestTargetsWithoutShape:
    ONE = DesignSpace((0, 0, 0, 0, 0, 0.2), (0, 0, 0, 0, 0, 2.5))

    @staticmethod
    def learned(run, space, sigma_m, **settings):
        config = config_of(
            space, **{"steps": 200, "batch": 256, "samples": 4000, "checkpoint_seconds": 100.0, **settings}
        )
        config = replace(config, density=DensitySettings(sigma_m=sigma_m))
        result = learn(BallTask(), config, run)
        for value in (result.ess, result.kl_nats, result.log_z, result.coverage, result.misplaced):
            assert math.isfinite(value)
        samples = load_samples(run)
        assert np.isfinite(-samples.log_prob.mean())  # its entropy
        return result, samples

    def test_one_free_dimension_has_the_closed_forms_log_z_however_thin_the_surface(self, tmp_path):
        sigma_m = 1e-3
        result, samples = self.learned(tmp_path, self.ONE, sigma_m, steps=300, layers=3, bins=16)
        assert (samples.points[:, :5] == 0).all()
        # a normal distribution about the front of the ball, a metre away; from one sigma behind it on T cuts in
        front = math.log(sigma_m * math.sqrt(2 * math.pi))
        error = references.STANDARD_ERRORS * result.error_estimates["log_z"].error
        assert front + math.log(0.84) - error < result.log_z < front + error
        assert np.average(samples.points[:, 5], weights=samples.weights) == pytest.approx(1.0, abs=2 * sigma_m)
        assert result.coverage > 0.9
        assert result.ess > 0.1

    def test_a_constant_target_is_met_by_the_uniform_density(self, tmp_path):
        result, samples = self.learned(tmp_path, SPACE, 1e3)
        assert result.ess > 0.5
        assert result.kl_nats < 0.5
        assert any("flat" in note for note in result.notes)
        assert log_volume(samples.space) >= -samples.log_prob.mean()  # no density has more entropy
