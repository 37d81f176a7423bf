"""Lengths in another unit, and splits that share a mesh, are told before anything takes time."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from lidardesign_tasks.meshes import load_folder
from lidardesign_tasks.units import doubtful_meshes, doubtful_motion
from support.command_line import caller

from lidardesign.config import load_run_config
from lidardesign.density.objective.prepare import resolution_notes
from lidardesign.errors import ConfigError, DataError, PluginError
from lidardesign.formats.designs import read_design
from lidardesign.sensors.compare import outside_notes
from lidardesign.space import DesignSpace
from lidardesign.task import load_task, notes_of

SPACE = DesignSpace(low=(1.0, 0, 0, 2.8, -0.4, 0.5), high=(1.0, 0, 0, 3.5, 0.4, 1.5))
QUICK = [word for key in ("poses=1", "truth_points=100", "density.field_resolution=8", "density.visibility=off")
         for word in ("--set", key)]  # fmt: skip


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """Three parts as a drawing program writes them, in millimetres."""
    folder = tmp_path_factory.mktemp("work") / "parts"
    folder.mkdir()
    for index, size in enumerate((120, 160, 211)):
        trimesh.creation.box((size, 60, 40)).export(folder / f"part_{index}.stl")
    return folder


@pytest.fixture
def call(capsys, parts, monkeypatch):
    return caller(capsys, parts.parent, monkeypatch)


def test_a_dry_run_says_once_for_all_parts_that_they_look_like_millimetres(call):
    result = call("learn", "meshes", "--set", "folder=parts", *QUICK, "--dry-run")
    assert result.code == 2, result.err  # as learning ends, see the next test
    (note,) = [line for line in result.err.splitlines() if line.startswith("note: ") and "millimetres" in line]
    assert note.startswith("note: 3 of 3 meshes")
    assert "part_2.stl with 211 m" in note
    assert "scale=0.001" in note
    scaled = call("learn", "meshes", "--set", "folder=parts", "--set", "scale=0.001", *QUICK, "--dry-run")
    assert "millimetres" not in scaled.err + scaled.out


def test_the_error_about_sigma_leaves_units_alone_where_scenes_are_small():
    found = {}
    for step in (0.9, 3.6):
        target = SimpleNamespace(space=SPACE, surfaces=SimpleNamespace(grid_steps_m=np.array([step])))
        with pytest.raises(ConfigError) as refused:
            resolution_notes(target, SimpleNamespace(sigma_m=0.002, field_resolution=16))
        found[step] = refused.value.hint
    assert found[0.9] == "raise density.field_resolution, or sigma"
    assert "about 58 m across" in found[3.6]


def test_large_meshes_are_doubted_only_where_no_unit_was_given():
    assert doubtful_meshes({"a.stl": 19.9}, 1.0) == doubtful_meshes({"a.stl": 300.0}, 0.01) == []
    assert doubtful_meshes({"a.stl": 300.0}, 1.0)[0].startswith("a.stl: is 300 m long")
    assert doubtful_meshes({"a.stl": 30.0, "b.stl": 1.0}, 1.0)[0].startswith("1 of 2 meshes")
    assert doubtful_meshes({"a.stl": 0.1}, 1.0, {"room.stl": 30.0})[0].startswith("1 of 2 meshes")


@pytest.mark.parametrize(
    ("sizes_m", "scale", "named"),
    [
        ([0.2] * 4 + [0.00027], 1.0, '"4": FACTOR, "*": 1'),
        ([0.2] * 8 + [200.0] * 4, 1.0, '"8": FACTOR, "*": 1'),
        ([0.0002] * 8 + [0.2] * 4, 0.001, '"8": FACTOR, "*": 0.001'),
        ([0.2] * 4 + [200.0], {"0": 2.0}, '"4": FACTOR, "0": 2'),
        ([0.2, 0.5, 9.0], 1.0, None),
    ],
)
def test_meshes_of_another_size_than_most_are_named_with_both_sizes_and_the_key(sizes_m, scale, named):
    notes = doubtful_meshes({str(number): size for number, size in enumerate(sizes_m)}, scale)
    assert len(notes) == (named is not None)
    assert named is None or all(text in notes[0] for text in (f"{sizes_m[0]:g} m", f"{sizes_m[-1]:g} m", named))


def test_a_folder_of_mixed_files_is_as_good_as_one_without_the_bad_ones_in_one_unit(tmp_path):
    task = load_task("meshes")
    for number in range(4):
        box = trimesh.creation.box((0.1 + 0.01 * number, 0.1, 0.1))
        for folder, factor in (("good", 1), ("mixed", 1 if number % 2 else 1000)):
            (tmp_path / folder).mkdir(exist_ok=True)
            box.copy().apply_scale(factor).export(tmp_path / folder / f"{'m' if factor == 1 else 'mm'}{number}.ply")
    (tmp_path / "mixed" / "empty.obj").write_text("")
    (tmp_path / "mixed" / "cloud.off").write_text("OFF\n1 0 0\n0 0 0\n")
    (tmp_path / "mixed" / "scan.las").write_text("x")

    def meshes_of(folder, **keys):
        config = task.Config(folder=tmp_path / folder, **keys)
        space = task.space(config)
        return load_folder(config), notes_of(task, config, space)

    with pytest.raises(DataError, match=r"2 of 6 meshes .* cloud.off: .*; empty.obj: ") as refused:
        meshes_of("mixed")
    keys = json.loads(refused.value.hint.partition("leave_out=")[2].rstrip("'"))
    assert keys == ["cloud.off", "empty.obj"]
    mixed, notes = meshes_of("mixed", leave_out=keys, scale={"mm*": 0.001})
    assert any(note == "left out: cloud.off, empty.obj" for note in notes)
    assert any(note.startswith("not read: scan.las (a point cloud") for note in notes)
    good = {name[1:]: mesh for name, mesh in meshes_of("good")[0]}
    assert {name.lstrip("m") for name, _ in mixed} == set(good)
    for name, mesh in mixed:
        np.testing.assert_allclose(mesh.vertices, good[name.lstrip("m")].vertices, rtol=1e-6)
    for keys in ({"leave_out": ["emty.obj"]}, {"scale": {"m*": 1, "x*": 2}}, {"leave_out": ["*"]}):
        with pytest.raises(ConfigError, match=next(iter(keys))):
            meshes_of("mixed", **keys)


@pytest.mark.parametrize("reach_m", [1.5, 2000.0])
def test_a_way_is_doubted_where_it_dwarfs_what_goes_it_or_no_sensor_reaches_it(reach_m):
    space = DesignSpace(low=SPACE.low, high=(*SPACE.high[:5], reach_m))

    def notes(start_m, end_m):
        return doubtful_motion({"ball": np.array([[-0.1, start_m, -0.1], [0.1, end_m, 0.1]])}, 0.2, space)

    assert notes(-0.3, 0.3) == notes(-6.0, 6.0) == doubtful_motion({}, 0.2, space) == []
    (line,) = notes(-300.0, 300.0)
    assert "millimetres" in line
    far = notes(300.0, 303.0)
    assert ["no nearer than 300 m" in note and "reach 1.5 m" in note for note in far] == [True] * (reach_m < 300)


def test_a_motion_in_millimetres_is_told_before_learning(call, parts):
    (parts.parent / "way.csv").write_text("time_s,body,x_m,y_m,z_m\n0,*,0,-300,0\n1,*,0,300,0\n")
    settings = ("--set", "folder=parts", "--set", "scale=0.001", "--set", "motion=way.csv")
    result = call("learn", "meshes", *settings, "--set", "frame_rate_hz=1", *QUICK, "--dry-run")
    assert "is the CSV in millimetres?" in result.err
    here = ("--set", "origin_m=[1, 0, 0]", "--set", "space.range_m=[0.5, 1.5]")
    (parts.parent / "way.csv").write_text("time_s,body,x_m,y_m,z_m\n0,*,0,300,0\n1,*,0,301,0\n")
    result = call("learn", "meshes", *settings, "--set", "frame_rate_hz=1", *here, *QUICK, "--dry-run")
    assert "where sensors may be" in result.err, result.err


def test_one_mesh_is_told_to_be_both_trained_on_and_held_out(tmp_path):
    task = load_task("meshes")
    for count in (1, 2):
        trimesh.creation.box((0.1 * count, 0.1, 0.1)).export(tmp_path / f"part{count}.stl")
        config = task.Config(folder=tmp_path)
        notes = notes_of(task, config, task.space(config))
        assert notes[0].startswith(f"{count} mesh")
        assert sum(note.startswith("part1.stl is the only mesh") for note in notes) == 2 - count


def test_notes_that_are_no_lines_are_the_tasks_fault():
    for found in ("one line", [3], [None]):
        task = SimpleNamespace(name="loud", notes=lambda config, space, found=found: found)
        with pytest.raises(PluginError, match="loud"):
            notes_of(task, None, SPACE)


RAYS = "origin_x_m,origin_y_m,origin_z_m,azimuth_rad,elevation_rad,gate_start_m,gate_end_m\n"


def rig(run, name, factor, start=0.3):
    """A rig at the corner of the run's design space, its lengths multiplied by a factor."""
    space = load_run_config(run)[1].space
    rows = [
        ",".join(f"{value:.6f}" for value in (*(factor * (1 + np.array(space.low[:3]))), 0.1 * index, 0.0,
                                              factor * start, factor * (start + 0.3)))
        for index in range(9)
    ]  # fmt: skip
    path = run.parent / name
    path.write_text(RAYS + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("factor", [1, 1000])
def test_a_rig_in_millimetres_is_told_wherever_it_meets_a_run(lidardesign, flat, factor):
    name = rig(flat, f"rig{factor}.csv", factor).name
    commands = (
        ("show", name, "--in", flat),
        ("evaluate", name, "--in", flat, "--rays", 9, "--set", "test=1", "--baseline", "none"),
    )
    for arguments in commands:
        result = lidardesign(*arguments)
        assert result.code == 0, result.err
        said = " ".join((result.out + result.err).split())
        assert ("m outside the run's design space; are its lengths in millimetres?" in said) == (factor > 1), arguments


def test_a_rig_that_hears_only_far_beyond_the_space_is_told(flat):
    space = load_run_config(flat)[1].space
    near = read_design(rig(flat, "near.csv", 1))
    far = read_design(rig(flat, "far.csv", 1, start=500.0))
    assert outside_notes(near, space) == []
    assert "listens from 500 m, but" in outside_notes(far, space)[0]
