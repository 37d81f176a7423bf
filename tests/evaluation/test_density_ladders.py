"""The sweeps of a density: errors against closed forms and exact references, falling measurement by measurement."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from scipy.stats import norm
from support.meshes import icosphere
from support.references import shape_distance

from lidardesign.config import DensitySettings, LearningSettings
from lidardesign.density.coordinates import Coordinates
from lidardesign.density.fields.distance import build_field
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.target import build_target
from lidardesign.density.training.learned import LearningSteps, gradient, in_arithmetic, noise_share, noise_shares
from lidardesign.density.training.losses import Pool
from lidardesign.density.training.quality import misplaced_share
from lidardesign.errors import NumericalError
from lidardesign.evaluation.accuracy import fields
from lidardesign.evaluation.accuracy import training as learning_steps
from lidardesign.evaluation.accuracy.fields import LOG_OPAQUE, exact_distances, fresh_table, opaque_target
from lidardesign.evaluation.accuracy.probes import draw_probes, few_columns, with_frames
from lidardesign.scenes.scene import Body, Box, Mesh, Receiver, Scene, Sphere, rigid
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, -0.35, -0.35, 0.5), (0, 0, 0, 0.35, 0.35, 3.5))
SETTINGS = DensitySettings(sigma_m=0.02)
BALL = icosphere(0.3, subdivisions=3)
pytestmark = pytest.mark.usefixtures("own_cache")


def box_mesh(half):
    made = trimesh.creation.box(extents=2 * np.array(half))
    return Mesh(made.vertices, made.faces)


def hidden_wall(place, kind=Box):
    """A wall behind a plate of 5 mm that hides a part of it."""
    make = Box if kind is Box else box_mesh
    wall = Body(make((0.05, 1.5, 1.5)), "wall", "both", rigid(translation_m=(3.05, 0, 0)))
    plate = Body(make((0.0025, 0.25, 0.25)), "plate", "occluder", rigid(translation_m=place))
    return Scene((wall, plate))


def balls(count, seed=0):
    places = np.random.default_rng(seed).uniform((1.9, -0.2, -0.2), (2.1, 0.2, 0.2), (count, 3))
    return [Scene((Body(BALL, "ball", "both", rigid(translation_m=place)),)) for place in places]


def moving_ball(frames):
    poses = np.stack([rigid(translation_m=(2.0, y, 0.0)) for y in np.linspace(-0.3, 0.3, frames)])
    return Scene((Body(Sphere(0.2), "ball", "both", poses),))


class TestMisplacedShare:
    def gaussians(self, apart, count=20_000, seed=0):
        points = np.random.default_rng(seed).normal(scale=2.0, size=count)
        return norm.logpdf(points), norm.logpdf(points - apart) + 3.0, norm.logpdf(points / 2.0)

    @pytest.mark.parametrize("apart", [0.01, 0.1, 1.0, 3.0])
    def test_is_the_total_variation_of_two_normal_densities(self, apart):
        share, error = misplaced_share(*self.gaussians(apart))
        assert abs(share - (2 * norm.cdf(apart / 2) - 1)) < 4 * error
        assert error < 0.05 * share + 1e-3

    def test_its_standard_error_is_the_spread_over_seeds(self):
        found = np.array([misplaced_share(*self.gaussians(0.5, 2000, seed)) for seed in range(200)])
        # the relative error of a standard deviation from 200 values is 5 %
        assert found[:, 0].std() == pytest.approx(found[:, 1].mean(), rel=0.2)

    def test_is_symmetric_at_most_one_and_nothing_at_any_other_scale(self):
        first, second, proposal = self.gaussians(0.5)
        assert misplaced_share(first, first + 7.0, proposal) == pytest.approx((0, 0), abs=1e-12)
        assert misplaced_share(first, second, proposal) == pytest.approx(misplaced_share(second, first, proposal))
        left, right = np.array([0.0, -np.inf]), np.array([-np.inf, 0.0])
        assert misplaced_share(left, right, np.zeros(2))[0] == 1.0

    def test_points_drawn_twice_count_as_one_of_twice_the_weight(self):
        first, second, proposal = (values[:50] for values in self.gaussians(0.5))
        twice = misplaced_share(*(np.repeat(values, 2) for values in (first, second, proposal)))
        once = misplaced_share(first, second, proposal - math.log(2))
        assert twice[0] == pytest.approx(once[0])

    @pytest.mark.parametrize("bad", [[0.0, np.nan], [0.0, np.inf], [-np.inf, -np.inf]])
    def test_what_is_no_density_is_refused(self, bad):
        with pytest.raises(NumericalError, match="no finite mass"):
            misplaced_share(np.array(bad), np.zeros(2), np.zeros(2))


class TestProbes:
    def test_points_are_distinct_and_stand_for_all_draws(self):
        scene = Scene((Body(Sphere(0.3), poses=rigid(translation_m=(2, 0, 0))),))
        space = DesignSpace((0, 0, 0, 0, -0.35, 0.5), (0, 0, 0, 0, 0.35, 3.5))
        target = build_target([scene], space, SETTINGS, "raycast")
        probes = draw_probes(target, 5000, 0, "test")
        assert len(np.unique(probes.points, axis=0)) == len(probes.points) < 5000
        # uniform points resampled by surface proximity: what repeated points lack in number they have in weight
        log_times = target.log_proximity(probes.points) - probes.log_proposal
        assert np.exp(log_times).round(9).sum() == 5000

    def test_few_columns_keep_some_frames_of_some_scenes(self):
        every = [moving_ball(50) for _ in range(10)]
        few = few_columns(every, 12)
        assert [scene.frames for scene in few] == [4, 4, 4]
        assert few_columns(every[:1], 64) == every[:1]
        assert with_frames(every[0], 2).bodies[0].poses.shape == (2, 4, 4)
        assert np.array_equal(with_frames(every[0], 2).bodies[0].poses[-1], every[0].bodies[0].poses[-1])


class TestOpaque:
    @pytest.mark.parametrize("kind", [Box, Mesh])
    def test_a_point_is_hidden_or_seen(self, kind):
        scene = hidden_wall((1.5, 0.0, 0.0), kind)
        target = opaque_target(build_target([scene], SPACE, SETTINGS, "raycast"))
        points = np.array([[0, 0, 0, 0.0, 0, 3.0], [0, 0, 0, 0.3, 0, 3.0 / math.cos(0.3)]])
        assert target.log_density(points) == pytest.approx([LOG_OPAQUE, 0.0], abs=1e-2)

    @pytest.mark.parametrize("kind", [Box, Mesh])
    def test_is_what_ray_casting_becomes_as_surfaces_get_harder(self, kind):
        scene = hidden_wall((1.5, 0.1, 0.0), kind)
        errors = []
        for attenuation in (1e2, 1e3, 1e4):
            settings = SETTINGS.model_copy(update={"attenuation_per_m": attenuation})
            target = build_target([scene], SPACE, settings, "raycast")
            probes = draw_probes(target, 4096, 0, "test")
            exact = opaque_target(target).log_density(probes.points)
            errors.append(probes.misplaced(target.log_density(probes.points), exact)[0])
        assert errors[0] > 3 * errors[1] > 9 * errors[2]

    def test_a_receiver_sees_past_nothing_either(self):
        receiver = Receiver((0.0, 1.0, 0.0), -0.3, 0.0, 1.5, 1.5, (0.1, 5.0))
        scene = Scene(hidden_wall((1.5, 0.5, 0.0), Mesh).bodies, receiver=receiver)
        target = opaque_target(build_target([scene], SPACE, SETTINGS, "raycast"))
        # the plate lies between the wall's middle and the receiver, not before the ray
        assert target.log_density(np.array([[0, 0, 0, 0.0, 0, 3.0]]))[0] == pytest.approx(LOG_OPAQUE, rel=1e-3)


class TestVisibilitySweep:
    @pytest.fixture(scope="class")
    @staticmethod
    def cases():
        places = [(1.2, 0.1, 0.0), (1.8, -0.1, 0.1)]
        few = {kind: [hidden_wall(place, kind) for place in places] for kind in (Box, Mesh)}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fields, "VISIBILITY_PROBES", 4096)
            patch.setattr(fields, "TABLE_PROBES", 1024)
            return {kind: fields.VisibilityCase.of(few[kind], SPACE, SETTINGS, seed=0, batch=64) for kind in few}

    @pytest.mark.parametrize("kind", [Box, Mesh])
    def test_ray_casting_is_chosen_where_thin_plates_hide_things(self, cases, kind):
        sweep = fields.visibility_sweep(cases[kind], 64, "raycast")
        off, quadrature, cast = sweep.measurements
        assert sweep.falls
        assert sweep.chosen is cast is sweep.default
        assert off.error > 0.05 > quadrature.error or off.error > quadrature.error > cast.error
        assert cast.error < 0.02

    def test_where_nothing_is_seen_there_is_nothing_to_choose(self, monkeypatch):
        monkeypatch.setattr(fields, "VISIBILITY_PROBES", 512)
        wall, _ = hidden_wall((1.5, 0, 0)).bodies
        screen = Body(Box((0.01, 5.0, 5.0)), "screen", "occluder", rigid(translation_m=(1.0, 0, 0)))
        assert fields.VisibilityCase.of([Scene((wall, screen))], SPACE, SETTINGS, 0).is_blind
        assert not fields.VisibilityCase.of([hidden_wall((1.5, 0, 0))], SPACE, SETTINGS, 0).is_blind

    def test_bodies_one_by_one_are_measured_on_few_scenes(self):
        every = [hidden_wall((1.5, 0, 0)) for _ in range(100)]
        assert len(fields.affordable_scenes(every)) == fields.MOST_BODIES // 2
        meshes = [hidden_wall((1.5, 0, 0), Mesh) for _ in range(100)]
        assert fields.affordable_scenes(meshes) is meshes


class TestComparedFields:
    POINTS = np.random.default_rng(0).uniform(-1, 1, (300, 3))

    def test_exact_distances_of_a_mesh_are_those_of_its_box(self):
        pose = rigid(trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))[:3, :3], (0.1, 0.2, -0.1))
        half = (0.3, 0.4, 0.5)
        scene = Scene((Body(box_mesh(half), poses=pose),))
        found = exact_distances([scene], self.POINTS)[:, 0]
        local = (self.POINTS - pose[:3, 3]) @ pose[:3, :3]
        assert found == pytest.approx(shape_distance(Box(half))(local), abs=1e-12)

    def test_exact_distances_mix_meshes_and_primitives_and_follow_motion(self):
        poses = np.stack([rigid(translation_m=(x, 0, 0)) for x in (-0.5, 0.5)])
        scene = Scene((Body(box_mesh((0.1, 0.1, 0.1)), poses=poses), Body(Sphere(0.2))))
        found = exact_distances([scene], self.POINTS)
        for frame, x in enumerate((-0.5, 0.5)):
            box = shape_distance(Box((0.1, 0.1, 0.1)))(self.POINTS - (x, 0, 0))
            assert found[:, frame] == pytest.approx(np.minimum(box, shape_distance(Sphere(0.2))(self.POINTS)))

    def test_an_open_mesh_has_no_inside(self):
        sheet = Mesh(np.array([[0.0, -9, -9], [0, 9, -9], [0, 0, 9]]), np.array([[0, 1, 2]]), "unsigned")
        found = exact_distances([Scene((Body(sheet),))], self.POINTS)[:, 0]
        assert found == pytest.approx(np.abs(self.POINTS[:, 0]))

    def test_a_fresh_table_is_the_table_of_learning(self):
        every = balls(3)
        cached = build_field(every, lambda body: body.is_target, resolution=16, padding_m=0.1)
        fresh = fresh_table(every[:2], every, 16, 0.1)
        assert np.array_equal(fresh.table, cached.table[:, :2])
        assert np.array_equal(fresh.grid.low, cached.grid.low)


class TestFieldSweeps:
    @pytest.fixture(scope="class")
    @staticmethod
    def case():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(fields, "PROBES", 4096)
            patch.setattr(fields, "COLUMNS", 2)
            settings = DensitySettings(sigma_m=0.02, field_resolution=24)
            return fields.FieldCase.of(balls(3), SPACE, settings, 0, "raycast")

    def test_errors_fall_with_resolution(self, case, monkeypatch):
        monkeypatch.setattr(fields, "RESOLUTIONS", (12, 24, 48))
        sweep = fields.resolution_sweep(case)
        assert sweep.falls
        errors = [measurement.values["distance_error_mm"] for measurement in sweep.measurements]
        # trilinear interpolation errs with the square of the step
        assert errors[0] > 2.5 * errors[1] > 6 * errors[2]
        assert sweep.measurements[0].error > sweep.measurements[2].error
        assert sweep.default.setting == "24"
        assert sweep.measurements[1].memory_bytes == case.target.surfaces.field.table.nbytes // 2 * 3

    def test_resolutions_that_take_long_are_left_out_beyond_the_runs_own(self, case, monkeypatch):
        monkeypatch.setattr(fields, "RESOLUTIONS", (8, 12, 48))
        monkeypatch.setattr(fields, "LONGEST_SECONDS", 0.0)
        sweep = fields.resolution_sweep(case)
        assert [measurement.setting for measurement in sweep.measurements] == ["8", "12", "24"]
        assert "48 and more points would take long" in sweep.note

    def test_meshes_that_move_have_a_grid_in_their_own_frame(self, monkeypatch):
        monkeypatch.setattr(fields, "PROBES", 512)
        monkeypatch.setattr(fields, "RESOLUTIONS", (12, 48))
        poses = np.stack([rigid(translation_m=(2.0, y, 0)) for y in (-0.1, 0.0, 0.1)])
        scene = Scene((Body(BALL, poses=poses),))
        case = fields.FieldCase.of([scene], SPACE, DensitySettings(sigma_m=0.02, field_resolution=48), 0, "off")
        sweep = fields.resolution_sweep(case)
        assert sweep.measurements[0].error > sweep.measurements[1].error
        assert sweep.measurements[1].memory_bytes == case.target.surfaces.field.bodies.grids.values.nbytes

    def test_primitives_need_no_field(self):
        request = SimpleNamespace(config=None, request=SimpleNamespace(train=[hidden_wall((1.5, 0, 0))]))
        assert fields.field_sweeps(request) == []


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIDARDESIGN_CACHE", str(tmp_path_factory.mktemp("cache")))
        every = balls(6)
        target = build_target(every, SPACE, SETTINGS, "raycast")
    probes = draw_probes(target, 512, 0, "test")
    coordinates = Coordinates(SPACE)
    flow = DesignFlow(
        len(coordinates.learned), 0, layers=1, hidden=8, bins=4, generator=torch.Generator().manual_seed(0)
    ).double()
    pool = Pool.of(SPACE.to_unit(probes.points), target.log_density(probes.points), probes.log_proposal)
    return LearningSteps(flow, target, LearningSettings(batch=64, layers=1, hidden=8, bins=4, frames=2), pool)


class TestGradients:
    def test_errors_are_shares_of_the_noise(self):
        generator = np.random.default_rng(0)
        exact = generator.normal(size=(200, 50)) + 5.0
        found = exact + 0.1 * generator.normal(size=exact.shape)
        share, error = noise_share(found, exact)
        assert abs(share - 0.1) < 4 * error + 1e-3
        assert noise_shares(found, exact) == pytest.approx(0.1, rel=0.5)
        assert noise_share(exact, exact) == (0.0, 0.0)

    def test_the_standard_error_is_the_spread_over_repetitions(self):
        generator = np.random.default_rng(2)
        found = []
        for _ in range(200):
            exact = generator.normal(size=(12, 20))
            found.append(noise_share(exact + 0.3 * generator.normal(size=exact.shape), exact))
        values, errors = np.array(found).T
        assert values.std() == pytest.approx(errors.mean(), rel=0.25)

    @pytest.mark.parametrize("kind", ["pathwise", "balancing"])
    def test_one_seed_gives_one_batch_in_any_arithmetic(self, steps, kind):
        loss = getattr(steps, kind)()
        exact = gradient(steps.flow, loss, 3, 1e9)
        rough = gradient(in_arithmetic(steps.flow, "float32"), loss, 3, 1e9)
        assert np.linalg.norm(rough - exact) < 1e-2 * np.linalg.norm(exact)
        assert np.array_equal(exact, gradient(steps.flow, loss, 3, 1e9))

    def test_what_is_not_finite_moves_nothing_and_the_flow_alone_takes_no_target(self, steps):
        found = gradient(steps.flow, lambda flow, generator: next(flow.parameters()).sum() * math.nan, 0, 1.0)
        assert not found.any()
        assert np.isfinite(gradient(steps.flow, steps.without_target().pathwise(), 0, 1.0)).all()


class TestSweepsOfSteps:
    def test_rounding_is_far_below_the_noise_of_a_batch(self, steps, monkeypatch):
        monkeypatch.setattr(learning_steps, "DTYPE_BATCHES", 4)
        sweep = learning_steps.dtype_sweep(steps, 0)
        rough, exact = sweep.measurements
        assert (rough.setting, exact.setting) == ("float32", "float64")
        assert rough.default
        assert exact.reference
        assert 0 < rough.error < sweep.tolerance

    def test_more_scenes_err_less(self, steps, monkeypatch):
        monkeypatch.setattr(learning_steps, "POWERS", (1, 4))
        monkeypatch.setattr(learning_steps, "FRAMES_BATCHES", 8)
        sweep = learning_steps.frames_sweep(steps, 0)
        assert [measurement.setting for measurement in sweep.measurements] == ["1", "2", "4", "6"]
        assert sweep.falls
        assert sweep.measurements[0].error > sweep.measurements[2].error > sweep.measurements[3].error == 0
        assert sweep.default.setting == "2"
        assert sweep.measurements[3].reference

    def test_settings_beyond_all_scenes_are_all_scenes(self):
        assert learning_steps.counts(50, 50) == [4, 16, 50]
        assert learning_steps.counts(2000, 256) == [4, 16, 64, 256, 2000]
