"""The target density: scenes tiny, huge and far away, sigma and beta at their ends, rays that start inside things."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import references
from support.designs import from_the_ceiling
from support.fits import fitted
from support.learning import SMALL, BallTask, learn
from support.visibility import along_axis, both_ways, config_of, plate, transmittance_on, wall

from lidardesign.config import (
    FARTHEST_M,
    FASTEST_PER_M,
    SHORTEST_M,
    DensitySettings,
    LearningSettings,
    RunConfig,
    resolve,
)
from lidardesign.constraints.document import Constraints
from lidardesign.density.coordinates import Coordinates
from lidardesign.density.fields.distance import build_field
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.prepare import ROUNDINGS, UNRESOLVED_SHARE, prepare_target
from lidardesign.density.objective.quadrature import Quadrature
from lidardesign.density.objective.surfaces import MovingFrames
from lidardesign.density.objective.target import build_target
from lidardesign.density.objective.visibility import MINIMUM_COSINE, Optics, RayBatch, Raycast
from lidardesign.density.training.losses import Pool, balancing_loss, pathwise_loss
from lidardesign.errors import ConfigError
from lidardesign.rays.proposals import Proposals
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Scene, Sphere, rigid
from lidardesign.sensors.pattern import even_rays
from lidardesign.space import ELEVATION, RANGE, DesignSpace, aim, direction, observed_point
from lidardesign.task import TaskConfig, load_task

WAYS = ("off", "quadrature", "raycast")
SPACE = DesignSpace((-0.1, -0.1, -0.1, -0.5, -0.5, 0.2), (0.1, 0.1, 0.1, 0.5, 0.5, 4.0))
SETTINGS = DensitySettings(sigma_m=0.05, attenuation_per_m=20.0, sharpness_per_m=40.0, margin_m=0.05)
CENTRES = ((2.0, 0.0, 0.0), (2.1, 0.2, 0.1), (1.8, -0.2, 0.0))
FRAMES = 5
ICOSPHERE = trimesh.creation.icosphere(subdivisions=2, radius=0.5)


pytestmark = pytest.mark.usefixtures("own_cache")


def ball_of_triangles(centre=(0.0, 0.0, 0.0), scale=1.0):
    return Mesh(scale * ICOSPHERE.vertices + np.array(centre), ICOSPHERE.faces)


def points_near(count=60, seed=0, spread=0.1):
    """Design points that listen around the near sides of balls at `CENTRES`, away from their silhouettes."""
    generator = np.random.default_rng(seed)
    points = SPACE.sample(count, generator)
    points[:, 3:5] = generator.uniform(-0.08, 0.08, (count, 2))
    points[:, RANGE] = 1.5 + generator.normal(scale=spread, size=count)
    return points


def balls(centres=CENTRES):
    return [Scene((Body(Sphere(0.5), poses=rigid(translation_m=centre)),)) for centre in centres]


def moving_scene(scale=1.0, offset=(0.0, 0.0, 0.0), turn=None):
    """A ball under a capsule, beside a box and above a floor; all but the floor move."""
    turn = np.eye(3) if turn is None else turn
    share = np.linspace(0, 1, FRAMES)
    start, step = np.array([-0.2, 0.1, 0.3]), np.array([0.4, -0.1, 0.1])

    def along(away):
        places = [np.array(offset) + scale * turn @ (start + s * step + np.array(away)) for s in share]
        return np.stack([rigid(turn, place) for place in places])

    half = (0.05 * scale, 0.04 * scale, 0.03 * scale)
    return Scene(
        (
            Body(Sphere(0.04 * scale), "ball", "target", along((0, 0, 0))),
            Body(Capsule(0.03 * scale, 0.1 * scale), "arm", "occluder", along((0.05, 0, 0.25))),
            Body(Box(half), "box", "both", along((0.2, 0.2, 0))),
            Body(Plane(), "floor", "occluder", rigid(turn, offset)),
        ),
        "moving",
    )


def moving_target(scale=1.0, offset=(0.0, 0.0, 0.0), turn=None):
    low, high = [np.array(offset) + scale * np.array([s, s, s]) for s in (-1.5, 1.5)]
    space = DesignSpace((*low, 0.0, -math.pi / 2, 0.0), (*high, 2 * math.pi, math.pi / 2, 4 * scale))
    settings = DensitySettings(
        sigma_m=0.03 * scale, attenuation_per_m=40.0 / scale, margin_m=0.03 * scale, surface_tolerance_nats=30.0
    )
    target = build_target([moving_scene(scale, offset, turn)], space, settings, visibility="raycast")
    assert isinstance(target.surfaces, MovingFrames)
    return target


def ceiling_points(scale=1.0, offset=(0.0, 0.0, 0.0), turn=None, count=400):
    space = DesignSpace((-0.5, -0.5, 1.0, 0.0, -math.pi / 2, 0.1), (0.5, 0.5, 1.0, 2 * math.pi, -math.pi / 4, 1.5))
    points = space.sample(count, np.random.default_rng(0))
    seen = observed_point(points)
    if turn is not None:
        points = aim(points[:, :3] @ turn.T, seen @ turn.T)
    points[:, :3] = np.array(offset) + scale * points[:, :3]
    points[:, RANGE] *= scale
    return points


def moved_samples(samples, scale, offset):
    points = samples.points.copy()
    points[:, :3] = points[:, :3] * scale + offset
    points[:, RANGE] *= scale
    bounds = []
    for side in (samples.space.low, samples.space.high):
        place = [value * scale + offset for value in side[:3]]
        bounds.append((*place, *side[3:5], side[RANGE] * scale))
    return Samples(points, samples.log_prob, samples.log_target, DesignSpace(*bounds))


def alike(points):
    """The same log p* everywhere."""
    return np.zeros(len(points))


def in_order(rays, scale=1.0, offset=0.0):
    rows = np.concatenate([(rays.origin_m - offset) / scale, rays.direction, rays.gate_m / scale], axis=1)
    return rows[np.lexsort(np.round(rows, 4).T)]


class ScaledBallTask(BallTask):
    """The ball at another size, somewhere else."""

    def __init__(self, scale, offset):
        self.scale, self.offset = scale, offset

    def scenes(self, config, split, seed):
        place = (1.5 * self.scale + self.offset, self.offset, self.offset)
        return [Scene((Body(Sphere(0.5 * self.scale), poses=rigid(translation_m=place)),))]


def learned(folder, scale, offset):
    """Samples of a short run in unit coordinates, and its ESS."""
    low = (-0.1 * scale + offset, offset, offset, -0.4, 0, 0.2 * scale)
    space = DesignSpace(low, (0.1 * scale + offset, offset, offset, 0.4, 0, 2.5 * scale))
    density = DensitySettings(sigma_m=0.05 * scale, attenuation_per_m=40 / scale, visibility="raycast")
    settings = LearningSettings(**{**SMALL, "steps": 30})
    config = RunConfig("ball", 3, "draft", TaskConfig(), space, density, settings)
    folder.mkdir()
    result = learn(ScaledBallTask(scale, offset), config, folder)
    return space.to_unit(load_samples(folder).points), result.ess


@pytest.fixture(scope="module")
def learned_at_home(tmp_path_factory):
    return learned(tmp_path_factory.mktemp("runs") / "home", 1.0, 0.0)


@pytest.mark.hard_case(
    "6",
    "Scenes of 0.1 mm or of 100 km, or 10,000 km from the origin",
    done="float64 throughout, fields and ray casting recentred on their meshes",
)
class TestScenesOfAnyScale:
    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize(("scale", "offset"), [(1e-4, 0.0), (1e5, 0.0), (1.0, 1e7)])
    def test_densities_over_meshes_scale_and_shift_with_the_scene(self, way, scale, offset):
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.5)

        def values(factor, shift):
            vertices = (mesh.vertices + np.array([2.0, 0, 0])) * factor + shift
            small = rigid(translation_m=np.array([1.0, 0.1, 0]) * factor + shift)
            scene = Scene((Body(Mesh(vertices, mesh.faces), "mesh"), Body(Sphere(0.1 * factor), poses=small)))
            settings = DensitySettings(
                sigma_m=0.05 * factor, attenuation_per_m=20 / factor, sharpness_per_m=40 / factor,
                margin_m=0.05 * factor, field_resolution=32,
            )  # fmt: skip
            points = points_near()
            points[:, :3] = points[:, :3] * factor + shift
            points[:, RANGE] *= factor
            return build_target([scene], SPACE, settings, way).log_density(points)

        # vertices at 1e7 m are rounded to 2e-9 m; distances are float32 relative to the scene
        np.testing.assert_allclose(values(scale, offset), values(1.0, 0.0), atol=references.SCALED_NATS)

    def test_a_moving_scene_far_away_has_the_same_density(self):
        offset = (1e7, -1e7, 1e7)
        found = moving_target(offset=offset).log_density(ceiling_points(offset=offset))
        # coordinates of 1e7 m are known to 2e-9 m
        np.testing.assert_allclose(found, moving_target().log_density(ceiling_points()), rtol=1e-5, atol=1e-5)

    @given(st.floats(-4, 5), st.floats(-1, 1), st.integers(0, 2**20))
    def test_turning_moving_and_scaling_the_world_leaves_every_density_as_it_is(self, decade, shift, seed):
        generator = np.random.default_rng(seed)
        scale, offset = 10.0**decade, 100 * 10.0**decade * shift * generator.normal(size=3)
        turn = Rotation.random(random_state=seed).as_matrix()
        moved = moving_target(scale, offset, turn).log_density(ceiling_points(scale, offset, turn, count=50))
        home = moving_target().log_density(ceiling_points(count=50))
        # angles of a ray are known to 2e-16 / cos(elevation), coordinates to 1e-14 of the scene
        np.testing.assert_allclose(moved, home, rtol=1e-7, atol=1e-7)

    @pytest.mark.parametrize(("scale", "offset", "atol"), [(1e-4, 0.0, 1e-12), (1.0, 1e7, 1e-4)])
    def test_a_learned_run_has_the_same_samples(self, tmp_path, learned_at_home, scale, offset, atol):
        home, ess = learned_at_home
        unit, found = learned(tmp_path / "away", scale, offset)
        # 2e-9 m of rounding at 1e7 m is 1e-9 in unit coordinates and grows over the steps
        np.testing.assert_allclose(unit, home, atol=atol)
        assert found == pytest.approx(ess, rel=10 * atol)

    @pytest.mark.parametrize("rules", [{}, {"origin": {"spread_m": {"max": 1e9}}}], ids=["places", "regions"])
    @pytest.mark.parametrize(("scale", "offset", "atol"), [(1e-4, 0.0, 1e-12), (1e5, 0.0, 1e-12), (1.0, 1e7, 1e-6)])
    def test_fitted_sensors_have_the_same_even_rays_and_candidates(self, rules, scale, offset, atol):
        even, candidates = [], []
        for factor, shift in ((1.0, 0.0), (scale, offset)):
            samples = moved_samples(from_the_ceiling(2000), factor, shift)
            found = fitted(samples, rules, sensors=2, em_samples=1000, restarts=1, retarget=alike)
            proposals = Proposals(found.sensors, Constraints.from_mapping(rules).rules, 0.95, samples)
            even.append(in_order(even_rays(found.sensors, [12, 8]), factor, shift))
            candidates.append(in_order(proposals.draw(20, {}, np.random.default_rng(0)), factor, shift))
        np.testing.assert_allclose(even[1], even[0], atol=atol)
        np.testing.assert_allclose(candidates[1], candidates[0], atol=atol)


def flow_of(coordinates, dtype):
    generator = torch.Generator().manual_seed(0)
    flow = DesignFlow(len(coordinates.learned), layers=1, hidden=8, bins=4, generator=generator)
    return flow.to(dtype), generator


FAR_AWAY = {
    "balls": balls(((1000.0, 0, 0), (1500.0, 0, 0))),
    "mesh": [Scene((Body(ball_of_triangles((1000.0, 0, 0))),))],
    "moving": [
        Scene((Body(Sphere(0.5), poses=np.stack([rigid(translation_m=(1000.0 + i, 0, 0)) for i in range(3)])),))
    ],
}


@pytest.mark.hard_case(
    "7",
    "All scenes far away: log p* below -1e5",
    done="the target stays in log space, without any log(p + epsilon)",
)
class TestScenesFarAway:
    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize("kind", FAR_AWAY)
    def test_values_are_finite_and_the_gradient_leads_to_the_scene(self, kind, way):
        target = build_target(FAR_AWAY[kind], SPACE, DensitySettings(field_resolution=16), way)
        values, gradient = target.log_density_and_gradient(points_near())
        assert np.isfinite(values).all()
        assert (values < -1e5).all()
        assert np.isfinite(gradient).all()
        assert (gradient[:, RANGE] > 0).all()

    def test_values_are_those_of_the_nearest_scene(self):
        target = build_target(FAR_AWAY["balls"], SPACE, SETTINGS, "off")
        points = points_near()
        nearest = np.linalg.norm(observed_point(points) - [1000.0, 0, 0], axis=1) - 0.5
        np.testing.assert_allclose(target.log_density(points), -np.square(nearest / 0.05) / 2, rtol=1e-12)

    @pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
    @pytest.mark.parametrize("sigma_m", [0.005, 1e-6])
    def test_both_losses_and_their_gradients_are_finite(self, dtype, sigma_m):
        target = build_target(FAR_AWAY["balls"], SPACE, DensitySettings(sigma_m=sigma_m), "raycast")
        coordinates = Coordinates(SPACE)
        flow, generator = flow_of(coordinates, dtype)
        points = SPACE.sample(64, np.random.default_rng(1))
        unit = SPACE.to_unit(points).clip(-1, 1)
        pool = Pool.of(unit, target.log_density(points), np.zeros(64))
        for loss, value, ess in (
            pathwise_loss(flow, target, coordinates, 32, sigma_m, 0.0, generator),
            balancing_loss(flow, target, coordinates, 32, pool, generator),
        ):
            flow.zero_grad()
            loss.backward()
            gradients = torch.cat([part.grad.reshape(-1) for part in flow.parameters() if part.grad is not None])
            assert math.isfinite(float(loss.detach()))
            assert value > 1e5
            assert 0 < ess <= 1
            assert torch.isfinite(gradients).all()
            assert gradients.abs().max() > 0


MESHES = ("mesh", "moving mesh")


def scene_with(kind):
    """A ball whose field of 32 grid points, hardly padded, has a step of 0.02 m."""
    poses = rigid(translation_m=(2.0, 0, 0))
    if kind == "moving mesh":
        poses = np.stack([poses, rigid(translation_m=(2.0, 0.1, 0))])
    return Scene((Body(ball_of_triangles(scale=0.62) if "mesh" in kind else Sphere(0.31), poses=poses),))


def prepared(kind, sigma_m, space=SPACE, **density):
    settings = DensitySettings(sigma_m=sigma_m, **{"visibility": "raycast", "field_resolution": 32, **density})
    return prepare_target([scene_with(kind)], SimpleNamespace(space=space, seed=0, density=settings))


@pytest.mark.hard_case(
    "8",
    "Sigma far below what the field resolves, or above the size of the scene",
    done="below a hundredth of a mesh field's step, or below the rounding of coordinates, it is an error that says "
    "both",
)
class TestSigmaAtBothEnds:
    @pytest.mark.parametrize("kind", MESHES)
    def test_sigma_below_the_field_resolution_is_an_error_that_says_both(self, kind):
        with pytest.raises(ConfigError, match=r"sigma 1e-08 m is far below the grid step 0\.02 m") as caught:
            prepared(kind, 1e-8)
        assert caught.value.exit_code == 2
        assert caught.value.where == "density.sigma_m"
        assert "density.field_resolution" in caught.value.hint

    @pytest.mark.parametrize("kind", MESHES)
    @pytest.mark.parametrize(("share", "noted"), [(2 * UNRESOLVED_SHARE, True), (0.4, True), (0.8, False)])
    def test_sigma_below_half_a_step_is_noted(self, kind, share, noted):
        _, notes = prepared(kind, share * 0.02)
        assert any("below half the field's grid step" in note for note in notes) == noted

    def test_what_has_an_exact_distance_bears_any_sigma_above_rounding(self):
        target, notes = prepared("ball", 1e-8, visibility="off")
        assert notes == []
        points = points_near(spread=1e-7)
        points[:, :5], points[:, RANGE] = 0.0, points[:, RANGE] + 0.19
        values, gradient = target.log_density_and_gradient(points)
        # coordinates of 2 m are known to 4e-16 m, 4e-8 of this sigma, times up to 40 sigma
        expected = -np.square((points[:, RANGE] - 1.69) / 1e-8) / 2
        np.testing.assert_allclose(values, expected, rtol=1e-6, atol=1e-5)
        assert np.isfinite(gradient).all()

    @pytest.mark.parametrize("kind", ["ball", "mesh"])
    def test_sigma_below_the_rounding_of_coordinates_is_an_error(self, kind):
        far = DesignSpace((1e7, 0, 0, 0, 0, 0), (1e7, 0, 0, 1, 1, 3))
        rounding = ROUNDINGS * np.spacing(1e7)
        with pytest.raises(ConfigError, match=r"below the rounding error of coordinates of 1e\+07 m"):
            prepared(kind, 0.9 * rounding, far)

    @pytest.mark.parametrize("kind", ["ball", "mesh", "moving mesh"])
    def test_a_sigma_above_the_size_of_the_scene_is_noted_as_flat(self, kind):
        _, notes = prepared(kind, 100.0)
        (note,) = [note for note in notes if "flat" in note]
        assert "sigma 100 m" in note
        assert "lower density.sigma_m" in note

    def test_a_wide_sigma_is_not_called_flat_where_the_density_still_tells_designs_apart(self):
        target, notes = prepared("ball", 1.0)
        assert np.ptp(target.log_proximity(SPACE.sample(256, np.random.default_rng(0)))) > 0.5
        assert notes == []
        point = DesignSpace((0, 0, 0, 0, 0, 1), (0, 0, 0, 0, 0, 1))
        assert prepared("ball", 100.0, point)[1] == []

    @pytest.mark.parametrize(
        "setting", ["density.sigma_m=1e-300", "density.attenuation_per_m=1e38", "density.sharpness_per_m=1e38"]
    )
    def test_what_would_overflow_is_refused_by_name(self, setting):
        with pytest.raises(ConfigError, match=setting.partition("=")[0]) as caught:
            resolve(load_task("flatland"), overrides=[setting])
        assert caught.value.allowed

    @given(
        st.floats(math.log10(SHORTEST_M), math.log10(FARTHEST_M)),
        st.floats(-9, math.log10(FASTEST_PER_M)),
        st.floats(-9, math.log10(FASTEST_PER_M)),
        st.sampled_from([0.0, 1e-9, 0.05, 1e9]),
    )
    def test_within_the_limits_every_density_and_gradient_is_finite(self, sigma, attenuation, sharpness, margin):
        settings = DensitySettings(
            sigma_m=min(max(10.0**sigma, SHORTEST_M), FARTHEST_M),
            attenuation_per_m=min(10.0**attenuation, FASTEST_PER_M),
            sharpness_per_m=min(10.0**sharpness, FASTEST_PER_M),
            margin_m=margin,
            field_resolution=8,
        )
        for scene in ALL_KINDS:
            for way in WAYS:
                values, gradient = build_target([scene], SPACE, settings, way).log_density_and_gradient(EVERYWHERE)
                assert np.isfinite(values).all()
                assert np.isfinite(gradient).all()


EVERYWHERE = DesignSpace((-1, -1, -1, -math.pi, -math.pi / 2, 0), (3, 1, 1, math.pi, math.pi / 2, 4)).sample(
    40, np.random.default_rng(2)
)
BEFORE = Body(Box((0.02, 0.3, 0.3)), "plate", "occluder", rigid(translation_m=(1.0, 0, 0)))
BALL = Body(Sphere(0.5), poses=rigid(translation_m=(2.0, 0, 0)))
ALL_KINDS = (
    Scene((BALL, BEFORE)),
    Scene((Body(ball_of_triangles((2.0, 0, 0))), BEFORE)),
)


@pytest.mark.hard_case(
    "9",
    "Beta large or small, occluders thinner than a step",
    done="ray casting is exact for plates of any thickness",
)
class TestThinOccludersAndAnyBeta:
    def test_behind_a_thin_plate_ray_casting_sees_nothing_however_thin(self):
        for thickness in (0.005, 0.0002, 1e-9):
            scene = Scene((wall(), plate(thickness)))
            assert transmittance_on(scene, Raycast([scene]), [2.0])[0] < 0.01

    def test_quadrature_is_refined_until_a_thin_plate_hides_what_is_behind(self):
        scene = Scene((wall(role="target"), plate(0.005, role="occluder")))
        target, notes = prepare_target([scene], config_of("quadrature", quadrature_points=16))
        assert any("refined from 16 to" in note for note in notes)
        assert not any("sees through" in note for note in notes)
        assert transmittance_on(scene, target.visibility, np.linspace(1.95, 2.05, 20), target.optics).max() < 0.01

    def test_quadrature_says_which_thickness_it_resolves_when_a_plate_is_too_thin(self):
        scene = Scene((wall(role="target"), plate(0.0002, role="occluder")))
        target, notes = prepare_target([scene], config_of("quadrature"))
        (warning,) = [note for note in notes if "sees through" in note]
        assert "thicker than 0.00" in warning
        assert "density.visibility=raycast" in warning
        assert target.visibility.points == 1024

    @pytest.mark.parametrize("beta", [1e-9, 1e-3, 1.0, 1e3, 1e6, FASTEST_PER_M])
    def test_ray_casting_follows_the_closed_form_for_every_beta(self, beta):
        optics = Optics(0.01, beta, 1000.0, 0.01)
        scene = Scene((plate(0.2),))
        ranges = np.concatenate([np.linspace(0, 2.4, 97), 0.91 + np.geomspace(1e-12, 1e-3, 20)])
        found = Raycast([scene]).transmittance(along_axis(ranges), np.ones((len(ranges), 1), bool), optics).log_values
        # hits of about 1 m are known to a few roundings
        expected = -beta * np.maximum(ranges - 0.01 - 0.9, 0.0)
        np.testing.assert_allclose(found[:, 0], expected, rtol=1e-9, atol=beta * 4 * np.spacing(1.0))

    @given(st.floats(-6, 12), st.floats(1e-6, 0.4), st.integers(0, 2**20))
    def test_cast_transmittance_is_a_share_that_never_rises_with_range(self, decade, thickness, seed):
        generator = np.random.default_rng(seed)
        azimuth, elevation = generator.uniform(-0.3, 0.3, 2)
        scene = Scene((plate(thickness, 0.8), Body(Sphere(0.2), poses=rigid(translation_m=(1.5, 0.1, 0))), wall()))
        ranges = np.sort(generator.uniform(0, 2.4, 60))
        looking = np.tile(direction(azimuth, elevation), (60, 1))
        rays = RayBatch(np.tile(generator.uniform(-0.1, 0.1, 3), (60, 1)), looking, ranges)
        found = cast(scene, rays, Optics(0.01, 10.0**decade, 1e3, 0.01))
        assert ((found >= 0) & (found <= 1)).all()
        assert (np.diff(found) <= 0).all()

    @pytest.mark.parametrize("beta", [1e-6, 1.0, 1e3, 1e9])
    @pytest.mark.parametrize("thing", ["thin", "thick", "mesh"])
    def test_integrated_transmittance_is_a_share_that_rises_by_no_more_than_its_own_step(self, beta, thing):
        mesh = ball_of_triangles((1.0, 0.1, 0), 0.6)
        body = {"thin": plate(0.002), "thick": plate(0.3), "mesh": Body(mesh)}[thing]
        field = build_field([Scene((body, wall()))], lambda one: True, resolution=48, padding_m=0.02)
        ranges = np.linspace(0, 2.4, 200)
        optics = Optics(0.01, beta, 1000.0, 0.01)
        quadrature = Quadrature(field, 1024)
        depth = -quadrature.transmittance(along_axis(ranges), np.ones((200, 1), bool), optics).log_values[:, 0]
        assert np.isfinite(depth).all()
        assert (depth >= 0).all()
        # midpoints move with the range: of a surface, one step more or less
        assert (np.diff(depth) >= -beta * 2.4 / 1024 - 1e-12).all()


SOLIDS = {
    "ball": Sphere(0.5),
    "box": Box((0.5, 0.5, 0.5)),
    "capsule": Capsule(0.5, 0.3),
    "cylinder": Cylinder(0.5, 0.5),
    "ellipsoid": Ellipsoid((0.5, 0.6, 0.7)),
    "mesh": ball_of_triangles(),
}
OPTICS = Optics(0.005, 1000.0, 1000.0, 0.005)


def rays_from(origin, looking, ranges):
    origins, directions = (np.tile(np.asarray(one, float), (len(ranges), 1)) for one in (origin, looking))
    return RayBatch(origins, directions, np.asarray(ranges, float))


def cast(scene, rays, optics=OPTICS):
    return np.exp(Raycast([scene]).transmittance(rays, np.ones((len(rays.ranges), 1), bool), optics).log_values[:, 0])


@pytest.mark.hard_case(
    "10",
    "A ray that starts inside an occluder or exactly on a surface, or grazes one",
    done="ray casting sees what simulation returns: from inside, the way out is the first hit",
)
class TestRaysThatStartInsideOrGraze:
    @pytest.mark.parametrize("name", SOLIDS)
    def test_from_inside_a_solid_it_is_dark_behind_the_way_out(self, name):
        scene, ranges = Scene((Body(SOLIDS[name]),)), np.linspace(0, 2, 201)
        looking = direction(0.3, 0.2)
        found = cast(scene, rays_from((0.1, 0, 0), looking, ranges))
        out = SceneCaster(scene).first_hit(np.array([[0.1, 0, 0]]), looking[None]).range_m[0]
        np.testing.assert_allclose(found, np.exp(-1000.0 * np.maximum(ranges - 0.005 - out, 0)), atol=1e-3)
        assert found[0] == 1.0
        assert found[-1] < 1e-100
        # the quadrature fades from the start
        rays = rays_from((0.1, 0, 0), looking, np.array([0.0, 0.005, 0.02, 0.1, 1.0]))
        soft = both_ways(scene)["quadrature"].transmittance(rays, np.ones((5, 1), bool), OPTICS).log_values[:, 0]
        np.testing.assert_allclose(np.exp(soft), np.exp(-1000.0 * np.maximum(rays.ranges - 0.005, 0)), atol=0.01)

    @pytest.mark.parametrize("name", ["ball", "box", "capsule"])
    @pytest.mark.parametrize("inward", [True, False])
    def test_on_a_surface_it_is_met_at_once(self, name, inward):
        ranges = np.linspace(0, 1, 101)
        found = cast(Scene((Body(SOLIDS[name]),)), rays_from((0.5, 0, 0), (-1.0 if inward else 1.0, 0, 0), ranges))
        np.testing.assert_allclose(found, np.exp(-1000.0 * np.maximum(ranges - 0.005, 0)), atol=1e-12)

    @pytest.mark.parametrize("way", WAYS)
    @pytest.mark.parametrize("name", [*SOLIDS, "plane"])
    def test_no_start_gives_a_value_or_gradient_that_is_no_number(self, name, way):
        shape = SOLIDS.get(name, Plane())
        starts = [(0, 0, 0), (0.5, 0, 0), (0.5, 0.5, 0.5), (0, 0, 0.5), (0.5, -1, 0), (0.2, 0.1, 0)]
        looks = [(azimuth, elevation) for azimuth in (0, math.pi / 2, math.pi) for elevation in (-math.pi / 2, 0, 0.5)]
        points = np.array([[*start, *look, reach] for start in starts for look in looks for reach in (0.0, 0.5, 2.0)])
        space = DesignSpace((-1, -1, -1, 0, -math.pi / 2, 0), (1, 1, 1, 2 * math.pi, math.pi / 2, 3))
        settings = SETTINGS.model_copy(update={"field_resolution": 24})
        target = build_target([Scene((Body(shape),))], space, settings, way)
        values, gradient = target.log_density_and_gradient(points)
        assert np.isfinite(values).all()
        assert np.isfinite(gradient).all()
        assert (values <= 1e-12).all()

    def test_a_ray_ever_flatter_over_a_plane_sees_ever_further_without_a_jump(self):
        scene, optics = Scene((Body(Plane()),)), Optics(0.01, 3.0, 1000.0, 0.01)
        dip = np.concatenate([[0.0], np.geomspace(1e-12, 0.5, 400)])
        looking = np.column_stack([np.cos(dip), np.zeros_like(dip), -np.sin(dip)])
        rays = RayBatch(np.tile([0.0, 0, 0.1], (401, 1)), looking, np.full(401, 2.0))
        found = cast(scene, rays, optics)
        with np.errstate(divide="ignore"):
            hit = 0.1 / np.sin(dip)
        np.testing.assert_allclose(found, np.exp(-3.0 * np.maximum(2.0 - 0.01 - hit, 0.0)), rtol=1e-9)
        # d hit / d dip = h / sin^2, at most range^2 / h before the limit
        assert np.abs(np.diff(found)).max() <= (3.0 * 2.0**2 / 0.1 * np.diff(dip)).max()

    @pytest.mark.parametrize("dip", [0.0, 1e-300, 1e-12, 1e-6, 0.01])
    def test_the_derivative_of_a_grazing_hit_is_capped(self, dip):
        scene = Scene((Body(Plane(), "floor", "occluder"), Body(Sphere(0.1), poses=rigid(translation_m=(3.0, 0, 0.1)))))
        space = DesignSpace((0, 0, 0, -1, -0.5, 0), (0, 0, 0.1, 1, 0.5, 4))
        target = build_target([scene], space, SETTINGS, "raycast")
        for height in (0.0, 1e-12, 1e-3):
            points = np.array([[0.0, 0, height, 0.0, 0, 2.9]])
            points[0, ELEVATION] = -dip
            values, gradient = target.log_density_and_gradient(points)
            assert np.isfinite(values).all()
            # beta over the least cosine, and over the lever of 3 m; the surface term adds its own slope
            assert np.abs(gradient).max() <= 20.0 / MINIMUM_COSINE * 3 + 3 * 0.3 / 0.05**2

    @pytest.mark.parametrize("name", ["ball", "capsule"])
    def test_across_a_silhouette_the_quadrature_is_continuous(self, name):
        field = build_field([Scene((Body(SOLIDS[name]),))], lambda one: True, resolution=16, padding_m=0.02)
        offset = np.linspace(0.4, 0.6, 2001)
        origins = np.column_stack([offset, np.full(2001, -1.0), np.zeros(2001)])
        rays = RayBatch(origins, np.tile([0.0, 1.0, 0], (2001, 1)), np.full(2001, 2.0))
        optics = Optics(0.01, 20.0, 200.0, 0.0)
        found = Quadrature(field, 1024).transmittance(rays, np.ones((2001, 1), bool), optics)
        passed = np.exp(found.log_values[:, 0])
        assert passed[0] < 1e-3
        assert passed[-1] > 0.99
        # the chord 2 sqrt(r^2 - x^2) grows within the soft edge of 1 / k = 5 mm: 20 / m * 0.2 m over 50 steps
        assert np.abs(np.diff(passed)).max() < 0.02
