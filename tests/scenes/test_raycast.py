"""First hits and crossings: closed forms against marching and Embree, precision, limits and bad rays."""

from __future__ import annotations

import gc
import math
import weakref

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support import references

from lidardesign.scenes import triangles
from lidardesign.scenes.casting import SceneCaster, shared_caster, trace_each
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Scene, Sphere, rigid
from lidardesign.scenes.triangles import mesh_caster

PRIMITIVES = {
    "sphere": Sphere(0.7),
    "box": Box((0.3, 0.5, 0.9)),
    "capsule": Capsule(0.3, 0.8),
    "cylinder": Cylinder(0.4, 0.8),
    "ellipsoid": Ellipsoid((0.3, 0.5, 0.9)),
    "plane": Plane(),
}
SOLIDS = {name: shape for name, shape in PRIMITIVES.items() if name != "plane"}
POSE = rigid(Rotation.from_rotvec([0.5, -1.1, 0.4]).as_matrix(), (0.3, -0.2, 0.1))


def rays_towards(count, seed, spread=0.6, distance=3.0):
    generator = np.random.default_rng(seed)
    origins = generator.normal(size=(count, 3))
    origins *= distance / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = generator.normal(scale=spread, size=(count, 3)) - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def solid_mesh(tessellation):
    return Mesh(np.asarray(tessellation.vertices), np.asarray(tessellation.faces))


def unlimited(count):
    return np.full(count, np.inf)


@pytest.mark.parametrize("name", PRIMITIVES)
def test_primitives_are_hit_where_marching_along_their_distance_arrives(name):
    caster = SceneCaster(Scene((Body(PRIMITIVES[name], poses=POSE),)))
    distance = references.shape_distance(PRIMITIVES[name])

    def world_distance(points):
        return distance((points - POSE[:3, 3]) @ POSE[:3, :3])

    origins, directions = rays_towards(800, 1, spread=0.4)
    outside = world_distance(origins) > 0
    origins, directions = origins[outside], directions[outside]
    marched = references.marched_hit(world_distance, origins, directions, 1e4)
    hits = caster.first_hit(origins, directions)
    assert np.isfinite(hits.range_m).mean() > 0.3
    agree = np.isfinite(marched) == np.isfinite(hits.range_m)
    assert agree.mean() > 0.99  # marching creeps along grazing rays
    both = np.isfinite(marched) & np.isfinite(hits.range_m)
    places = origins[both] + hits.range_m[both, None] * directions[both]
    # of a kilometre's range a float64 keeps 1e-13 m, a few times over
    assert (np.abs(world_distance(places)) < 1e-12 + 1e-14 * hits.range_m[both]).all()
    assert np.quantile(np.abs(marched[both] - hits.range_m[both]), 0.9) < 1e-6


@pytest.mark.parametrize("name", PRIMITIVES)
def test_normals_are_the_gradient_of_the_distance_and_face_the_ray(name):
    shape = PRIMITIVES[name]
    caster = SceneCaster(Scene((Body(shape, poses=POSE),)))
    origins, directions = rays_towards(500, 2)
    hits = caster.first_hit(origins, directions)
    hit = np.isfinite(hits.range_m)
    local = (origins[hit] + hits.range_m[hit, None] * directions[hit] - POSE[:3, 3]) @ POSE[:3, :3]
    gradient = references.numerical_gradient(references.shape_distance(shape), local, 1e-6) @ POSE[:3, :3].T
    smooth = np.abs(np.linalg.norm(gradient, axis=1) - 1) < 1e-4  # not at a box's edge
    cosine = np.einsum("nk,nk->n", hits.normal[hit], gradient)[smooth]
    np.testing.assert_allclose(np.abs(cosine), 1.0, atol=1e-5)
    assert (np.einsum("nk,nk->n", hits.normal[hit], directions[hit]) <= 0).all()
    assert (hits.normal[~hit] == 0).all()
    assert (hits.body[~hit] == -1).all()


@pytest.mark.parametrize("name", SOLIDS)
def test_a_ray_that_starts_inside_hits_its_way_out(name):
    caster = SceneCaster(Scene((Body(SOLIDS[name], poses=POSE),)))
    _, directions = rays_towards(200, 4)
    hits = caster.first_hit(np.tile(POSE[:3, 3], (200, 1)), directions)
    places = POSE[:3, 3] + hits.range_m[:, None] * directions
    local = (places - POSE[:3, 3]) @ POSE[:3, :3]
    assert np.abs(references.shape_distance(SOLIDS[name])(local)).max() < 1e-12


def test_a_ray_that_starts_on_a_plane_hits_it_at_once_and_a_parallel_one_never():
    caster = SceneCaster(Scene((Body(Plane()),)))
    origins = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 1]])
    directions = np.array([[0.0, 0, -1], [0, 0, 1], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_array_equal(caster.first_hit(origins, directions).range_m, [0.0, 0.0, np.inf, np.inf])


def test_rays_along_axes_faces_and_edges_are_exact():
    box = SceneCaster(Scene((Body(Box((1.0, 1.0, 1.0))),)))
    origins = np.array([[3.0, 0, 0], [3, 1, 0], [3, 1, 1], [3, 1.0000001, 0]])
    hits = box.first_hit(origins, np.array([-1.0, 0, 0]) + np.zeros((4, 3)))
    np.testing.assert_array_equal(hits.range_m, [2.0, 2.0, 2.0, np.inf])
    capsule = SceneCaster(Scene((Body(Capsule(0.5, 1.0)),)))
    along_axis = capsule.first_hit([[0.0, 0, 4], [0.3, 0, -4], [0.6, 0, 4]], [[0.0, 0, -1], [0, 0, 1], [0, 0, -1]])
    np.testing.assert_allclose(along_axis.range_m, [2.5, 3 - 0.4, np.inf], atol=1e-14)


def test_no_ray_slips_through_the_seam_between_a_capsules_side_and_its_caps():
    capsule = Capsule(0.3, 0.8)
    turn = np.random.default_rng(5).uniform(0, 2 * math.pi, 20_000)
    seam = np.stack([0.3 * np.cos(turn), 0.3 * np.sin(turn), np.full(20_000, 0.8)], axis=1)
    origins = 3.0 * np.random.default_rng(6).normal(size=(20_000, 3))
    # only rays that come from outside at the seam itself
    outward = seam - [0, 0, 0.8]
    ahead = np.einsum("nk,nk->n", origins - seam, outward) > 0.1
    directions = (seam - origins)[ahead]
    hits = SceneCaster(Scene((Body(capsule),))).first_hit(origins[ahead], directions)
    np.testing.assert_allclose(hits.range_m, np.linalg.norm(directions, axis=1), atol=1e-9)


def mixed_scene(shift=(0.0, 0.0, 0.0)):
    moved = rigid(translation_m=shift)
    mesh = solid_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.5))
    return Scene(
        (
            Body(mesh, "mesh", poses=moved),
            Body(Sphere(0.4), "ball", role="occluder", poses=moved @ rigid(translation_m=(0.8, 0, 0))),
            Body(Box((0.2, 0.2, 0.2)), "box", role="target", poses=moved @ rigid(translation_m=(0, 0.9, 0))),
            Body(Capsule(0.1, 0.5), "stick", poses=moved @ rigid(translation_m=(0, 0, 0.9))),
        )
    )


def test_the_nearest_body_wins_whatever_its_kind():
    scene = mixed_scene()
    origins, directions = rays_towards(2000, 8, spread=0.7)
    together = SceneCaster(scene).first_hit(origins, directions)
    casters = [SceneCaster(Scene((Body(body.shape, poses=body.poses),))) for body in scene.bodies]
    alone = np.stack([caster.first_hit(origins, directions).range_m for caster in casters])
    np.testing.assert_array_equal(together.range_m, alone.min(axis=0))
    hit = together.body >= 0
    np.testing.assert_array_equal(together.body[hit], alone.argmin(axis=0)[hit])
    assert set(together.body) == {-1, 0, 1, 2, 3}


@pytest.mark.parametrize(("only", "bodies"), [("all", {0, 1, 2, 3}), ("targets", {0, 2, 3}), ("occluders", {0, 1, 3})])
def test_rays_hit_only_the_bodies_that_are_asked_for(only, bodies):
    hits = SceneCaster(mixed_scene(), only=only).first_hit(*rays_towards(2000, 9, spread=0.7))
    assert set(hits.body) - {-1} == bodies


def test_a_limit_is_open_a_hit_at_it_is_a_miss():
    scene = mixed_scene()
    origins, directions = rays_towards(500, 10)
    caster = SceneCaster(scene)
    free = caster.trace(origins, directions, unlimited(500))
    at_hit = caster.trace(origins, directions, free.range_m)
    primitive = free.body > 0
    assert (at_hit.body[primitive] != free.body[primitive]).all()
    hit = free.body >= 0
    beyond = caster.trace(origins[hit], directions[hit], free.range_m[hit] * (1 + 1e-6))
    np.testing.assert_array_equal(beyond.body, free.body[hit])
    assert (caster.trace(origins, directions, np.full(500, -1.0)).body == -1).all()
    assert (caster.trace(origins, directions, np.zeros(500)).body == -1).all()


@pytest.mark.hard_case("17")
def test_chunks_of_rays_do_not_change_the_bits():
    caster = SceneCaster(mixed_scene())
    origins, directions = rays_towards(9001, 11)
    whole = caster.first_hit(origins, directions)
    chunks = (slice(0, 7), slice(7, 5000), slice(5000, None))
    parts = [caster.first_hit(origins[rows], directions[rows]) for rows in chunks]
    for name in ("range_m", "body", "normal"):
        assert getattr(whole, name).tobytes() == np.concatenate([getattr(part, name) for part in parts]).tobytes()


def test_rays_that_start_far_away_are_advanced_before_float32():
    origins, directions = rays_towards(1000, 13, spread=0.2, distance=1e5)
    mesh = SceneCaster(Scene((Body(solid_mesh(trimesh.creation.box((1.0, 1.0, 1.0)))),)))
    exact = SceneCaster(Scene((Body(Box((0.5, 0.5, 0.5))),)))
    found, expected = mesh.first_hit(origins, directions), exact.first_hit(origins, directions)
    steep = np.abs(np.einsum("nk,nk->n", expected.normal, directions)) > 0.2
    hit = steep & np.isfinite(found.range_m)
    assert hit.sum() > 500
    # a direction in float32 is off by 6e-8 rad, which over the last few metres is less than a micrometre
    assert np.abs(found.range_m[hit] - expected.range_m[hit]).max() < 10 * references.EMBREE_M


def test_crossings_are_all_hits_one_after_another():
    scene = mixed_scene()
    caster = SceneCaster(scene)
    origins, directions = rays_towards(300, 14)
    found = caster.crossings(origins, directions, np.zeros(300), unlimited(300))
    for ray in range(300):
        expected, start = [], 0.0
        while True:
            place = origins[[ray]] + start * directions[[ray]]
            hit = caster.first_hit(place, directions[[ray]]).range_m[0]
            if not np.isfinite(hit):
                break
            expected.append(start + hit)
            start += hit + 1e-5
        mine = np.sort(found.range_m[found.row == ray])
        np.testing.assert_allclose(mine, expected, atol=2e-5)


def test_crossings_keep_to_their_window():
    caster = SceneCaster(mixed_scene())
    origins, directions = rays_towards(500, 15)
    everything = caster.crossings(origins, directions, np.zeros(500), unlimited(500))
    window = caster.crossings(origins, directions, np.full(500, 2.4), np.full(500, 2.9))
    inside = (everything.range_m >= 2.4) & (everything.range_m < 2.9)
    assert inside.sum() > 50
    expected = np.sort((everything.range_m + 10 * everything.row)[inside])
    np.testing.assert_allclose(np.sort(window.range_m + 10 * window.row), expected, atol=1e-5)
    assert (window.cosine >= 0).all()
    assert (window.cosine <= 1 + 1e-6).all()


def test_a_shared_caster_is_built_once_per_frame_and_set_of_bodies():
    both = Scene((Body(Sphere(1.0)),))
    assert shared_caster(both, only="targets") is shared_caster(both, only="occluders")
    mixed = mixed_scene()
    assert shared_caster(mixed, only="targets") is not shared_caster(mixed, only="occluders")
    assert shared_caster(mixed) is not shared_caster(mixed_scene())


def posed_meshes(poses_of, seed=20, shift=(0.0, 0.0, 0.0)):
    """A moving box, ball and screw of triangles, and one that rests."""
    generator = np.random.default_rng(seed)
    solids = [
        trimesh.creation.box((0.5, 0.8, 0.3)),
        trimesh.creation.icosphere(subdivisions=3, radius=0.4),
        trimesh.creation.cylinder(0.2, 1.2, sections=40),
        trimesh.creation.box((0.2, 0.2, 2.0)),
    ]
    bodies = []
    for index, solid in enumerate(solids):
        solid.apply_translation(generator.normal(size=3))  # the mesh is not centred in its own frame
        rotations = Rotation.random(3, random_state=seed + index).as_matrix()
        poses = np.stack([rigid(rotation, shift + generator.normal(size=3)) for rotation in rotations])
        bodies.append((solid_mesh(solid), poses_of(poses, index)))
    return bodies


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (1e5, -2e5, 3e4)])
def test_moving_meshes_are_hit_as_if_each_frame_were_a_scene_at_rest(shift):
    shift = np.array(shift)
    moving = posed_meshes(lambda poses, index: poses if index < 3 else poses[0], shift=shift)
    scene = Scene(tuple(Body(mesh, poses=poses) for mesh, poses in moving))
    origins, directions = rays_towards(4000, 21, spread=0.9)
    origins = origins + shift
    for frame in range(3):
        resting = Scene(tuple(Body(body.shape, poses=body.pose(frame)) for body in scene.bodies))
        found = SceneCaster(scene, frame).first_hit(origins, directions)
        expected = SceneCaster(resting).first_hit(origins, directions)
        # rays at edges may fall to either side
        same = (found.body == expected.body) & (np.abs(np.einsum("nk,nk->n", expected.normal, directions)) > 0.1)
        assert (found.body == expected.body).mean() > 0.999
        assert set(found.body[same]) == {0, 1, 2, 3}
        np.testing.assert_allclose(
            found.range_m[same], expected.range_m[same], rtol=1e-5, atol=10 * references.EMBREE_M
        )
        aligned = np.einsum("nk,nk->n", found.normal[same], expected.normal[same])
        assert np.mean(aligned > 1 - 1e-5) > 0.999
        crossed, walked = (
            caster.crossings(origins, directions, np.zeros(4000), unlimited(4000))
            for caster in (SceneCaster(scene, frame), SceneCaster(resting))
        )
        assert abs(len(crossed.row) - len(walked.row)) <= 0.002 * len(walked.row)


def test_a_limit_and_the_set_of_bodies_hold_for_moving_meshes():
    moving = posed_meshes(lambda poses, index: poses)
    roles = ("target", "occluder", "both", "occluder")
    scene = Scene(tuple(Body(mesh, poses=poses, role=role) for (mesh, poses), role in zip(moving, roles, strict=True)))
    origins, directions = rays_towards(2000, 22, spread=0.9)
    free = SceneCaster(scene, 1).trace(origins, directions, unlimited(2000))
    hit = free.body >= 0
    before = SceneCaster(scene, 1).trace(origins[hit], directions[hit], free.range_m[hit] * (1 - 1e-5))
    assert (before.body == -1).all()
    beyond = SceneCaster(scene, 1).trace(origins[hit], directions[hit], free.range_m[hit] * (1 + 1e-5))
    np.testing.assert_array_equal(beyond.body, free.body[hit])
    targets = SceneCaster(scene, 1, only="targets").first_hit(origins, directions)
    assert set(targets.body) == {-1, 0, 2}


def test_a_mesh_is_built_once_for_all_frames_and_scenes(monkeypatch):
    built = []
    make = triangles.Triangles.__init__

    def counted(self, meshes):
        built.append(len(meshes))
        make(self, meshes)

    monkeypatch.setattr(triangles.Triangles, "__init__", counted)
    mesh = solid_mesh(trimesh.creation.icosphere(subdivisions=2, radius=0.123))
    floor = solid_mesh(trimesh.creation.box((9.0, 9.0, 0.1)))
    poses = np.stack([rigid(translation_m=(0.001 * i, 0, 1)) for i in range(1000)])
    scenes = [Scene((Body(shape, poses=poses), Body(floor))) for shape in (mesh, mesh)]
    casters = [SceneCaster(scene, frame) for scene in scenes for frame in range(scene.frames)]
    assert len(casters) == 2000
    assert built == [1, 1]  # the moving mesh, and the floor that all scenes have in one place
    hits = casters[500].first_hit([[0.5, 0, 3.0]], [[0.0, 0, -1]])
    assert hits.range_m[0] == pytest.approx(3 - 1.123, abs=1e-6)


def test_a_caster_lives_as_long_as_its_mesh():
    mesh = solid_mesh(trimesh.creation.box((0.3, 0.3, 0.31)))
    caster = weakref.ref(mesh_caster(mesh))
    assert mesh_caster(mesh) is caster()
    del mesh
    gc.collect()
    assert caster() is None


@pytest.mark.parametrize("with_a_sphere", [False, True])
def test_casting_for_many_scenes_at_once_is_casting_for_each(with_a_sphere):
    sphere = (Body(Sphere(0.4), poses=POSE),) if with_a_sphere else ()
    balls = [solid_mesh(trimesh.creation.icosphere(subdivisions=2, radius=0.3 * n)) for n in range(1, 5)]
    meshes = [Body(ball, poses=rigid(translation_m=(0.1 * n, 0, 0))) for n, ball in enumerate(balls)]
    casters = [SceneCaster(Scene((mesh, *sphere))) for mesh in meshes]
    counts = [0, 200, 7, 300]
    starts = np.concatenate([[0], np.cumsum(counts)])
    origins, directions = rays_towards(starts[-1], 3, distance=5.0)
    origins[::3] *= 1e5  # some start where float32 cannot tell them apart
    limit_m = np.where(np.arange(len(origins)) % 2, np.inf, 4.0)
    found = trace_each(casters, starts, origins, directions, limit_m)
    assert 0.05 < (found.body >= 0).mean() < 0.95
    for caster, begin, end in zip(casters, starts[:-1], starts[1:], strict=True):
        part = caster.trace(origins[begin:end], directions[begin:end], limit_m[begin:end])
        for name in ("range_m", "body", "normal"):
            np.testing.assert_array_equal(getattr(found, name)[begin:end], getattr(part, name))


def test_scenes_of_the_same_bodies_share_what_is_built_of_their_meshes_and_others_do_not():
    ball = solid_mesh(trimesh.creation.icosphere(subdivisions=1, radius=0.4))
    balls = [Body(ball, f"ball {i}", poses=rigid(translation_m=(2.0 + i, 0, 0))) for i in range(2)]
    first, second = Scene(tuple(balls), "first"), Scene(tuple(balls), "second")
    alone = Scene((balls[0],), "alone")
    resting = [SceneCaster(scene).at_rest for scene in (first, second, alone)]
    assert resting[0] is resting[1]
    assert resting[2] is not resting[0]
