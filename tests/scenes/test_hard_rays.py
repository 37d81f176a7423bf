"""Rays at meshes: vertices and edges, and directions that are none."""

from __future__ import annotations

from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support import references

from lidardesign.errors import ConfigError
from lidardesign.evaluation.score import slipped_notes
from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Scene, Sphere, rigid
from lidardesign.scenes.triangles import BESIDE_SHARE, SecondCasts
from lidardesign.scoring.scene_scores import score_in_scene
from lidardesign.simulate.plan import Planner
from lidardesign.task import Metric, Score


def mesh_of(solid):
    return Mesh(np.asarray(solid.vertices), np.asarray(solid.faces))


BALL = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
SOLIDS = {
    "icosphere": BALL,
    "uv sphere": trimesh.creation.uv_sphere(radius=0.7, count=(48, 48)),
    "box": trimesh.creation.box((1.0, 0.6, 1.4)),
    "cylinder": trimesh.creation.cylinder(0.5, 1.0, sections=60),
}
STARTS = {
    "centre": (0.0, 0.0, 0.0),
    "inside": (0.21, -0.13, 0.08),
    "outside": (3.0, 0.4, -0.9),
    "far": (4e3, 1e3, -2e3),
}


def aimed(solid, start):
    """Rays from a start at all vertices and middles of edges that face it, and how far these are."""
    vertices = np.asarray(solid.vertices)
    ends = vertices[solid.edges_unique]
    outward = np.concatenate([solid.vertex_normals, solid.vertex_normals[solid.edges_unique].sum(axis=1)])
    places = np.concatenate([vertices, ends.mean(axis=1)])
    offset = places - np.asarray(start)
    reach = np.linalg.norm(offset, axis=1)
    inside = np.linalg.norm(start) < 0.3
    # at a grazing angle a rounding decides whether the near or the far side is met
    facing = inside | (np.einsum("nk,nk->n", offset, outward) < -0.3 * reach * np.linalg.norm(outward, axis=1))
    directions = offset[facing] / reach[facing, None]
    return np.tile(np.asarray(start, float), (len(directions), 1)), directions, reach[facing]


class CountingTask:
    """The share of rays with a return."""

    name = "counting"
    metric = Metric("returns", "%", "higher", worst=0.0, tolerance=1.0)

    def score(self, scene, returns):
        return Score(100.0 * float(np.mean(returns[0].returned)))


@pytest.mark.hard_case(
    "17",
    "A ray through an edge or a vertex of a mesh",
    done="Embree's robust mode, and a second cast from a millionth of the mesh's size beside for rays that met "
    "nothing or a triangle's back",
)
class TestRaysThroughEdgesAndVertices:
    @pytest.mark.parametrize("start", STARTS)
    @pytest.mark.parametrize("name", SOLIDS)
    def test_none_is_lost_and_all_are_met_where_they_aim(self, name, start):
        origins, directions, reach = aimed(SOLIDS[name], STARTS[start])
        found = SceneCaster(Scene((Body(mesh_of(SOLIDS[name])),))).first_hit(origins, directions)
        assert len(reach) > 5
        # from 4 km away a float64 direction is off by 1e-12 m, Embree's own rounding and the step aside come on top
        np.testing.assert_allclose(found.range_m, reach, rtol=0, atol=10 * references.EMBREE_M)
        assert (found.body == 0).all()

    @pytest.mark.parametrize("moves", [False, True])
    def test_none_is_lost_in_a_mesh_that_is_turned_or_moves(self, moves):
        turn = rigid(Rotation.from_rotvec([0.4, 1.0, -0.3]).as_matrix(), (0.3, -2.0, 1.0))
        poses = np.stack([np.eye(4), turn]) if moves else turn
        origins, directions, reach = aimed(BALL, STARTS["outside"])
        origins, directions = origins @ turn[:3, :3].T + turn[:3, 3], directions @ turn[:3, :3].T
        caster = SceneCaster(Scene((Body(mesh_of(BALL), poses=poses),)), frame=1 if moves else 0)
        np.testing.assert_allclose(
            caster.first_hit(origins, directions).range_m, reach, rtol=0, atol=10 * references.EMBREE_M
        )

    def test_a_body_behind_does_not_take_the_place_of_a_vertex(self):
        wall = Body(Box((0.01, 9.0, 9.0)), "wall", poses=rigid(translation_m=(-3.0, 0.0, 0.0)))
        origins, directions, reach = aimed(BALL, STARTS["outside"])
        found = SceneCaster(Scene((Body(mesh_of(BALL)), wall))).first_hit(origins, directions)
        assert (found.body == 0).all()
        np.testing.assert_allclose(found.range_m, reach, rtol=0, atol=10 * references.EMBREE_M)

    def test_hits_are_those_of_a_naive_tracer_in_float64(self):
        solid = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
        generator = np.random.default_rng(5)
        origins, directions, _ = aimed(solid, STARTS["outside"])
        aside = generator.normal(size=directions.shape)
        beside = directions + 0.05 * aside
        origins = np.concatenate([origins, origins])
        directions = np.concatenate([directions, beside / np.linalg.norm(beside, axis=1, keepdims=True)])
        expected = references.naive_mesh_hit(np.asarray(solid.vertices), np.asarray(solid.faces), origins, directions)
        found = SceneCaster(Scene((Body(mesh_of(solid)),))).first_hit(origins, directions).range_m
        assert 0.01 < np.isinf(expected).mean() < 0.5
        np.testing.assert_array_equal(np.isinf(found), np.isinf(expected))
        hit = np.isfinite(expected)
        np.testing.assert_allclose(found[hit], expected[hit], rtol=0, atol=20 * references.EMBREE_M)

    def test_rays_that_pass_an_outline_still_miss(self):
        ball = mesh_of(BALL)
        turns = np.linspace(0, 2 * np.pi, 500, endpoint=False)
        # rays along -x graze the outline of a convex hull at its largest extent across x
        for beyond in (3 * BESIDE_SHARE, 1e-4, 0.1):
            across = np.stack([np.zeros(500), np.cos(turns), np.sin(turns)], axis=1)
            extent = (ball.vertices @ across.T).max(axis=0) + beyond * 2
            origins = np.array([3.0, 0, 0]) + extent[:, None] * across
            caster = SceneCaster(Scene((Body(ball),)))
            found = caster.first_hit(origins, np.tile([-1.0, 0, 0], (500, 1)))
            assert np.isinf(found.range_m).all()
            assert caster.second_casts == SecondCasts(500, 500, 0)

    def test_how_many_had_slipped_is_counted_and_told(self):
        origins, directions, _ = aimed(BALL, STARTS["centre"])
        count = len(origins)
        rays = Rays(origins, directions, np.tile([0.0, 2.0], (count, 1)), np.zeros(count), np.zeros(count))
        scene = Scene((Body(mesh_of(BALL)),), "ball")
        found = score_in_scene(CountingTask(), CountingTask.metric, scene, [[rays]], Planner(choice="none"), None, 0)
        assert found.scores[0][0].value == 100.0
        slipped = found.second_casts
        assert slipped.rays == count
        assert 0.0005 < slipped.found / count < 0.01
        again = ForkingPickler.loads(ForkingPickler.dumps(found)).second_casts
        assert again == slipped
        (note,) = slipped_notes(again)
        assert f"{slipped.found} of {count:,} rays" in note
        assert "vertices" in note

    def test_a_scene_without_such_rays_is_told_nothing(self):
        assert slipped_notes(SecondCasts(1_000_000, 400_000, 2)) == []
        assert slipped_notes(SecondCasts()) == []


BAD_DIRECTIONS = {
    "zero": [0.0, 0.0, 0.0],
    "nan": [np.nan, 0.0, 1.0],
    "infinite": [np.inf, 0.0, 1.0],
    "minus infinite": [0.0, -np.inf, 0.0],
}
ONE_OF_EACH = {
    "sphere": Sphere(0.7),
    "box": Box((0.5, 0.6, 0.7)),
    "capsule": Capsule(0.5, 0.3),
    "cylinder": Cylinder(0.5, 0.6),
    "ellipsoid": Ellipsoid((0.5, 0.6, 0.7)),
    "plane": Plane(),
    "mesh": mesh_of(trimesh.creation.icosphere(subdivisions=2, radius=0.7)),
}


@pytest.mark.hard_case(
    "18",
    "A direction that is zero, not a number, or not of unit length",
    done="zero and not a number are errors before anything is traced",
)
class TestDirectionsThatAreNone:
    @pytest.mark.parametrize("case", BAD_DIRECTIONS)
    @pytest.mark.parametrize("shape", ONE_OF_EACH)
    def test_it_is_an_error_and_never_a_silent_miss(self, case, shape):
        caster = SceneCaster(Scene((Body(ONE_OF_EACH[shape]),)))
        with pytest.raises(ConfigError, match=r"rays.*not finite, or a direction has zero length"):
            caster.first_hit(np.full((2, 3), 3.0), np.array([[-1.0, -1.0, -1.0], BAD_DIRECTIONS[case]]))

    @given(exponent=st.floats(-307, 307), shape=st.sampled_from(list(ONE_OF_EACH)))
    def test_ranges_are_metres_whatever_the_length(self, exponent, shape):
        caster = SceneCaster(Scene((Body(ONE_OF_EACH[shape]),)))
        origins, directions = np.full((1, 3), 2.0), np.array([[-0.9, -1.0, -1.05]])
        expected = caster.first_hit(origins, directions).range_m
        assert np.isfinite(expected).all()
        found = caster.first_hit(origins, directions * 10.0**exponent).range_m
        # one rounding of the direction more, magnified by the way
        np.testing.assert_allclose(found, expected, rtol=10 * references.EMBREE_M if shape == "mesh" else 1e-12)

    def test_a_ray_list_takes_only_unit_vectors(self):
        gate, one = np.array([[0.0, 1.0]]), np.zeros(1)
        for bad in ([0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1.0, 1e-2, 0.0]):
            with pytest.raises(ConfigError, match=r"rays\.direction"):
                Rays(np.zeros((1, 3)), np.array([bad]), gate, one, one)
        with pytest.raises(ConfigError, match="NaN or infinite"):
            Rays(np.zeros((1, 3)), np.array([[np.nan, 0.0, 0.0]]), gate, one, one)
