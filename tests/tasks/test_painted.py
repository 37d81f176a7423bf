"""Where weights come from: painted files, the roughness of surfaces, regions of interest; what tasks make of them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from lidardesign_tasks.emitter import EmitterConfig, EmitterTask
from lidardesign_tasks.face import FaceConfig, FaceTask
from lidardesign_tasks.importance import (
    LEAST_ROUGHNESS,
    Importance,
    relative_area,
    relative_roughness,
    vertex_roughness,
)
from lidardesign_tasks.meshes import MeshesConfig, MeshesTask
from lidardesign_tasks.poses import rotation_matrix
from pydantic import ValidationError
from support.meshes import save

from lidardesign.errors import ConfigError, DataError
from lidardesign.scenes.mesh_files import Painted, check_mesh, load_mesh

SENSOR = np.array([3.0, 0.5, 0.2])
COLOURED = ("ply", "glb", "gltf", "obj")


def ball(radius=1.0, subdivisions=2):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def arrays(mesh):
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def painted_ball(grey):
    """A ball whose vertices are grey from 0 to 255 as a function of their places."""
    mesh = ball()
    colours = np.full((len(mesh.vertices), 4), 255, dtype=np.uint8)
    colours[:, :3] = np.round(grey(mesh.vertices))[:, None]
    mesh.visual.vertex_colors = colours
    return mesh


def weight_at(mesh, places):
    """The weights of a mesh at vertices that are at these places."""
    apart = np.linalg.norm(mesh.vertices[:, None] - places[None], axis=2)
    assert (apart.min(axis=0) < 1e-5).all()
    return mesh.importance[apart.argmin(axis=0)]


@pytest.mark.parametrize("suffix", COLOURED)
def test_the_brightness_of_vertex_colours_is_the_weight_in_every_format_that_has_them(tmp_path, suffix):
    mesh = painted_ball(lambda v: 127.5 * (1 + v[:, 2]))
    loaded = load_mesh(save(mesh, tmp_path / f"ball.{suffix}"), painted=Painted("colours", 100.0))
    brightness = np.round(127.5 * (1 + mesh.vertices[:, 2])) / 255
    assert np.allclose(weight_at(loaded, mesh.vertices), 100.0**brightness, rtol=1e-3)
    assert loaded.importance.max() == pytest.approx(100.0, rel=0.01)
    assert load_mesh(tmp_path / f"ball.{suffix}").importance is None


def test_green_is_brighter_than_blue_as_eyes_and_television_have_it(tmp_path):
    mesh = ball()
    found = []
    for channel in range(3):
        colours = np.zeros((len(mesh.vertices), 4), dtype=np.uint8)
        colours[:, [channel, 3]] = 255
        mesh.visual.vertex_colors = colours
        loaded = load_mesh(save(mesh, tmp_path / "ball.ply"), painted=Painted("colours", 10.0))
        found.append(float(np.log10(loaded.importance).mean()))
    assert found == pytest.approx([0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("scalar_care", {"file_type": "ply", "encoding": "binary"}),
        ("scalar_care", {"file_type": "ply", "encoding": "ascii"}),
        ("_care", {"file_type": "glb"}),
    ],
)
def test_a_property_of_a_file_is_the_weight_itself(tmp_path, name, options):
    mesh = ball()
    mesh.vertex_attributes[name] = np.exp(mesh.vertices[:, 0]).astype(np.float32)
    path = tmp_path / f"ball.{options['file_type']}"
    path.write_bytes(mesh.export(**options))
    loaded = load_mesh(path, painted=Painted(name))
    assert np.allclose(weight_at(loaded, mesh.vertices), np.exp(mesh.vertices[:, 0]), rtol=1e-5)


def test_a_property_that_is_not_there_is_answered_with_those_that_are(tmp_path):
    mesh = ball()
    mesh.vertex_attributes["quality"] = np.ones(len(mesh.vertices), dtype=np.float32)
    path = save(mesh, tmp_path / "ball.ply")
    with pytest.raises(DataError) as refused:
        load_mesh(path, painted=Painted("qualty"))
    assert "qualty" in str(refused.value)
    assert "quality, colours" in str(refused.value)
    assert "ball.ply" in str(refused.value)


@pytest.mark.parametrize(("what", "words"), [("faces", "faces"), (None, "no colours")])
def test_a_file_without_vertex_colours_is_refused(tmp_path, what, words):
    mesh = ball()
    if what == "faces":
        mesh.visual.face_colors = np.arange(len(mesh.faces) * 4).reshape(-1, 4) % 256
    with pytest.raises(DataError, match=words):
        load_mesh(save(mesh, tmp_path / "ball.ply"), painted=Painted("colours"))


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, 1e9])
def test_values_that_are_no_weights_are_refused_with_their_number(tmp_path, value):
    mesh = ball()
    weights = np.ones(len(mesh.vertices), dtype=np.float32)
    weights[:3] = value
    mesh.vertex_attributes["care"] = weights
    with pytest.raises(DataError, match="care of 3 vertices"):
        load_mesh(save(mesh, tmp_path / "ball.ply"), painted=Painted("care"))


def test_vertices_that_become_one_count_as_their_geometric_mean_and_lost_ones_not_at_all():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0), (1, 0, 0), (0, 0, 1), (5, 5, 5)], dtype=float)
    weights = np.array([1.0, 2.0, 3.0, 4.0, 2.0, 6.0, 1e5])
    mesh = check_mesh(vertices, [(0, 1, 2), (3, 5, 4)], importance=weights)
    assert len(mesh.vertices) == 4
    assert np.allclose(weight_at(mesh, vertices[[0, 1, 2, 5]]), [2.0, 2.0, 3.0, 6.0])
    with pytest.raises(DataError, match="weights for 7 vertices"):
        check_mesh(vertices, [(0, 1, 2), (3, 5, 4)], importance=weights[:5])


@pytest.mark.parametrize("radius", [0.05, 0.2])
def test_the_roughness_of_a_ball_is_the_spread_of_heights_of_its_caps(radius):
    # a cap that a ball of radius r cuts is r^2 / (2 R) high, and evenly so in area (Archimedes)
    found = vertex_roughness(*arrays(ball(subdivisions=5)), radius)
    expected = radius**2 / 2 / np.sqrt(12)
    assert found.mean() == pytest.approx(expected, rel=0.05)
    assert found.std() < 0.15 * expected


def test_roughness_is_that_of_the_surface_and_not_of_its_triangles():
    vertices, faces = arrays(ball(radius=1.0, subdivisions=4))
    above = np.flatnonzero(vertices[faces].mean(axis=1)[:, 2] > 0)
    finer = trimesh.remesh.subdivide(vertices, faces, face_index=above)
    plain, found = vertex_roughness(vertices, faces, 0.3), vertex_roughness(*finer, 0.3)
    assert len(found) > 2 * len(plain)
    assert found[finer[0][:, 2] > 0.3].mean() == pytest.approx(plain[vertices[:, 2] < -0.3].mean(), rel=0.05)


def test_relative_roughness_knows_neither_units_nor_poses():
    vertices, faces = arrays(trimesh.creation.capsule(height=0.6, radius=0.2))
    plain = relative_roughness(vertices, faces, 0.1)
    turned = vertices @ rotation_matrix(np.array([0.3, -0.5, 0.2])).T + 2.0
    assert np.allclose(relative_roughness(turned, faces, 0.1), plain, rtol=1e-6)
    assert np.allclose(relative_roughness(1000 * vertices, faces, 100.0), plain, rtol=1e-9)


def test_the_far_side_of_a_thin_plate_makes_it_no_rougher():
    plate = trimesh.creation.box((1.0, 1.0, 0.02))
    vertices, faces = trimesh.remesh.subdivide_to_size(plate.vertices, plate.faces, 0.1)
    found = vertex_roughness(vertices, faces, 0.1)
    middle = (np.abs(vertices[:, :2]) < 0.35).all(axis=1)
    assert middle.sum() > 20
    assert found[middle].max() < 1e-9
    assert found.max() > 1e-4  # the rim


def test_balls_too_small_to_measure_with_are_refused_with_the_least():
    vertices, faces = arrays(ball(radius=1.0))
    with pytest.raises(ConfigError, match=r"(?s)roughness_radius_m.*at least 0\.016 m"):
        vertex_roughness(vertices, faces, 0.001)
    assert vertex_roughness(vertices, faces, 0.02).max() > 0


def test_a_surface_that_is_flat_everywhere_counts_evenly():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float) + 10.0
    assert np.array_equal(relative_roughness(vertices, np.array([(0, 1, 2), (0, 2, 3)]), 0.3), np.ones(4))


def test_nothing_is_asked_for_by_default_and_the_exponent_is_one():
    vertices, faces = arrays(trimesh.creation.capsule(height=0.6, radius=0.2))
    assert Importance().weights(vertices, faces, SENSOR) is None
    once, twice = (
        Importance(roughness_exponent=e, roughness_radius_m=0.1).weights(vertices, faces, SENSOR) for e in (1.0, 2.0)
    )
    assert np.allclose(once**2, twice)
    assert once.min() >= LEAST_ROUGHNESS


def test_rays_weighted_by_the_area_that_they_see_are_even_over_the_surface():
    # a tilted plate: r^2 / cos is the area in a solid angle, in closed form
    plate = trimesh.creation.box((1.0, 1.0, 0.01))
    vertices, faces = trimesh.remesh.subdivide_to_size(plate.vertices, plate.faces, 0.1)
    vertices = vertices @ rotation_matrix(np.array([0.0, 0.7, 0.0])).T
    found = relative_area(vertices, faces, SENSOR)
    normal = rotation_matrix(np.array([0.0, 0.7, 0.0])) @ [0, 0, 1]
    look = vertices - SENSOR
    exact = np.linalg.norm(look, axis=1) ** 3 / np.abs(look @ normal)
    inner = np.abs(vertices @ rotation_matrix(np.array([0.0, 0.7, 0.0]))).max(axis=1) < 0.45
    assert inner.sum() > 100
    ratio = found[inner] / exact[inner]
    assert np.ptp(ratio) < 1e-9 * ratio.mean()
    assert np.median(found) == pytest.approx(1.0)
    half = Importance(area_exponent=0.5).weights(vertices, faces, SENSOR)
    assert np.allclose(half**2, found)


def test_the_rim_of_a_ball_counts_no_more_than_tenfold():
    vertices, faces = arrays(ball(subdivisions=4))
    found = relative_area(vertices, faces, np.array([1e4, 0.0, 0.0]))
    # the middle of what is seen counts least, the rim ten times as much
    cosine = np.abs(vertices[:, 0])
    relative = found / found.min()
    assert np.allclose(1 / relative, np.maximum(cosine, 0.1), atol=0.01)
    assert relative.max() == pytest.approx(10.0, rel=1e-3)


@pytest.mark.parametrize("shape", [{"region_radius_m": 0.1}, {"region_half_size_m": (0.1, 0.1, 0.1)}])
@pytest.mark.parametrize("edge", [0.0, 0.05])
def test_a_region_counts_its_weight_inside_and_nothing_more_beyond_its_edge(shape, edge):
    config = Importance(region_centre_m=(1, 2, 3), region_weight=9.0, region_edge_m=edge, **shape)
    along = np.array([0.0, 0.09, 0.0999, 0.125, 0.1501, 1.0])
    found = config.weights(np.array([1, 2, 3]) + along[:, None] * [0, -1, 0], np.zeros((0, 3), dtype=int), SENSOR)
    expected = [9, 9, 9, 3, 1, 1] if edge else [9, 9, 9, 1, 1, 1]
    assert np.allclose(found, expected)


@pytest.mark.parametrize(
    "keys",
    [
        {"region_radius_m": 0.1},
        {"region_centre_m": (0, 0, 0)},
        {"region_centre_m": (0, 0, 0), "region_radius_m": 0.1, "region_half_size_m": (1, 1, 1)},
        {"region_centre_m": (0, 0, 0), "region_half_size_m": (1, 0, 1)},
        {"region_centre_m": (0, 0, 0), "region_radius_m": 0.0},
        {"region_weight": 8.0},
        {"region_edge_m": 0.02},
        {"region_centre_m": (0, 1e300, 0), "region_radius_m": 1.0},
        {"roughness_exponent": -1},
    ],
)
def test_half_a_region_and_impossible_numbers_are_refused(keys):
    with pytest.raises(ValidationError):
        Importance(**keys)


@pytest.mark.parametrize(("task", "kind"), [(FaceTask(), FaceConfig), (EmitterTask(), EmitterConfig)])
def test_all_heads_of_a_model_count_alike_vertex_by_vertex(task, kind):
    config = kind(train=2, test=1, roughness_exponent=0.5, region_centre_m=(0, 0, 0), region_radius_m=0.03)
    meshes = [scene.bodies[0].shape for split in ("train", "test") for scene in task.scenes(config, split, 0)]
    assert all(np.array_equal(mesh.importance, meshes[0].importance) for mesh in meshes)
    assert len({mesh.content_hash for mesh in meshes}) == 3
    plain = task.scenes(kind(train=1), "train", 0)[0].bodies[0].shape
    assert plain.importance is None
    assert plain.content_hash == meshes[0].content_hash
    # the nose counts four times what its roughness says
    only = task.scenes(kind(train=1, roughness_exponent=0.5), "train", 0)[0].bodies[0].shape
    ratio = meshes[0].importance / only.importance
    assert ratio.max() == pytest.approx(4.0)
    assert ratio.min() == pytest.approx(1.0)
    tip = plain.vertices[np.argmax(ratio > 3.9)]
    assert np.linalg.norm(tip) < 0.05


def test_meshes_of_a_folder_count_by_their_paint_their_roughness_and_a_region(tmp_path):
    for name in ("a", "b"):
        save(painted_ball(lambda v: np.where(v[:, 0] > 0, 255, 0)), tmp_path / f"{name}.ply")
    common = {"folder": tmp_path, "up": "z", "poses": 1}

    def weights(**keys):
        scene = MeshesTask().scenes(MeshesConfig(**common, **keys), "train", 0)[0]
        return scene.bodies[0].shape.importance

    assert weights() is None
    paint = weights(importance="colours", colour_contrast=5.0)
    assert sorted(np.unique(paint.round(9))) == [1.0, 5.0]
    region = weights(region_centre_m=(0, 0, 1), region_radius_m=0.5)
    rough = weights(roughness_exponent=1.0, roughness_radius_m=0.5)
    area = weights(area_exponent=0.5)
    every = weights(
        importance="colours", colour_contrast=5.0, region_centre_m=(0, 0, 1), region_radius_m=0.5,
        roughness_exponent=1.0, roughness_radius_m=0.5, area_exponent=0.5,
    )  # fmt: skip
    assert np.allclose(every, paint * region * rough * area)
    with pytest.raises(DataError, match="no vertex property 'care'"):
        weights(importance="care")


def test_a_region_beside_all_surfaces_is_refused_with_where_these_are(tmp_path):
    save(painted_ball(lambda v: 0 * v[:, 0]), tmp_path / "ball.ply")
    beside = {"region_centre_m": (0, 0, 30), "region_radius_m": 0.5}
    with pytest.raises(ConfigError, match=r"(?s)region holds no vertex.*z -1 to 1 m"):
        MeshesTask().scenes(MeshesConfig(folder=tmp_path, **beside), "train", 0)
    with pytest.raises(ConfigError, match="region holds no vertex"):
        FaceTask().scenes(FaceConfig(train=1, **beside), "train", 0)


def test_a_contrast_without_colours_is_refused():
    with pytest.raises(ValidationError, match="importance=colours"):
        MeshesConfig(importance="care", colour_contrast=3.0)
