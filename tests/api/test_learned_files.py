"""Files that come to a folder, go, change or are renamed after a run was learned: what is held out stays held out."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from lidardesign_tasks.meshes import MeshesConfig
from lidardesign_tasks.robot.recordings import read_recordings
from lidardesign_tasks.robot.task import MujocoConfig
from support.command_line import caller
from support.meshes import write_ball

import lidardesign as ld
from lidardesign.api.learn import LearnRequest
from lidardesign.config import with_task_settings
from lidardesign.errors import ConfigError, DataError
from lidardesign.run.manifest import read_manifest
from lidardesign.run_folder import RunFolder, input_hashes

NAMES = [f"{letter}.stl" for letter in "cdefgh"]
SMALL = {
    "learning.steps": 4, "learning.batch": 64, "learning.samples": 2000, "density.sigma_m": 0.05, "truth_points": 100,
    "poses": 1,
}  # fmt: skip


def ball(path, number):
    write_ball(path, (0.1 + 0.01 * number, 0.08, 0.06))


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    place = tmp_path_factory.mktemp("kept")
    for number, name in enumerate(NAMES):
        ball(place / "meshes" / name, number)
    (place / "meshes" / "readme.txt").write_text("balls")
    ld.learn("meshes", preset="draft", out=place / "run", settings={**SMALL, "folder": place / "meshes"})
    shutil.copytree(place / "meshes", place / "as learned")
    return place


@pytest.fixture
def place(learned):
    shutil.rmtree(learned / "meshes", ignore_errors=True)
    shutil.copytree(learned / "as learned", learned / "meshes")
    return learned


def splits(run, seed=0):
    """The mesh of each scene of both splits, by its name, and where its points are."""
    return {
        split: {scene.group: scene.bodies[0].shape.vertices.mean() + scene.bodies[0].poses.sum() for scene in scenes}
        for split in ("train", "test")
        for scenes in [run.scenes(split, seed)]
    }


def come(folder):
    for number, name in enumerate(["a.stl", "dd.stl", "z.stl"]):
        ball(folder / name, 20 + number)


def renumber(folder):
    for name in reversed(NAMES):
        (folder / name).rename(folder / f"{chr(ord(name[0]) + 1)}.stl")
    ball(folder / "c.stl", 20)


def swap(folder):
    first, second = (folder / name for name in ("c.stl", "h.stl"))
    content = first.read_bytes(), second.read_bytes()
    first.write_bytes(content[1])
    second.write_bytes(content[0])


CHANGES = {
    "nothing": (lambda folder: None, None),
    "other files": (lambda folder: (folder / "notes.txt").write_text("no mesh"), None),
    "new ones": (come, "a.stl, dd.stl, z.stl"),
    "renumbered": (renumber, "c.stl"),
    "swapped": (swap, None),
    "a copy": (lambda folder: shutil.copy(folder / "c.stl", folder / "copy.stl"), "copy.stl"),
}


@pytest.mark.parametrize(("change", "named"), CHANGES.values(), ids=CHANGES)
def test_scenes_are_those_that_were_learned_and_newcomers_are_named(place, change, named):
    run = ld.open_run(place / "run")
    before, metric = splits(run), run.metric
    change(place / "meshes")
    run = ld.open_run(place / "run")
    assert (splits(run), run.metric) == (before, metric)
    notes = run.input_notes()
    assert len(notes) == (named is not None)
    assert named is None or notes[0].startswith(f"{named}: added after")


def test_no_setting_moves_a_mesh_between_learning_and_scoring(place):
    run, copy = ld.open_run(place / "run"), shutil.copytree(place / "meshes", place / "copy")
    elsewhere = run.with_settings([f"folder={copy}"])
    assert (splits(elsewhere), elsewhere.metric) == (splits(run), run.metric)
    (copy / "c.stl").unlink()
    (place / "one").mkdir()
    shutil.copy(place / "meshes" / next(iter(splits(run)["train"])), place / "one")
    for setting in ("test_share=0.2", "test_share=0.8", f"folder={copy}", f"folder={place}/one"):
        with pytest.raises(ConfigError, match="changes which files are held out"):
            run.with_settings([setting])
    shutil.rmtree(place / "meshes")
    assert ld.open_run(place / "run").summary()["metric"]["unit"] == run.metric.unit


def test_what_went_or_changed_moves_no_other_mesh(place):
    before = splits(ld.open_run(place / "run"))
    gone, changed = (next(iter(before[split])) for split in ("train", "test"))
    (place / "meshes" / gone).unlink()
    ball(place / "meshes" / changed, 30)
    come(place / "meshes")
    run = ld.open_run(place / "run")
    assert {split: list(scenes) for split, scenes in splits(run).items()} == {
        split: [name for name in scenes if name != gone] for split, scenes in before.items()
    }
    said = " ".join(run.input_notes())
    assert all(words in said for words in (f"{changed} changed", f"{gone} is gone", "z.stl"))


@pytest.mark.parametrize(("kept", "words"), [("test", "training"), ("train", "held-out"), (None, "none of the files")])
def test_a_split_of_which_nothing_is_left_is_refused(place, kept, words):
    run = ld.open_run(place / "run")
    keep = [] if kept is None else splits(run)[kept]
    come(place / "meshes")
    for name in NAMES:
        if name not in keep:
            (place / "meshes" / name).unlink()
    with pytest.raises(DataError, match=words):
        splits(run)


def test_every_command_keeps_them_and_learning_again_takes_newcomers_in(place, capsys, tmp_path, monkeypatch):
    lidardesign = caller(capsys, tmp_path, monkeypatch)
    come(place / "meshes")
    run = place / "run"
    for command in (
        ["show", run],
        ["fit", run, "--sensors", 1, "--rays", 4, "--layout", "even"],
        ["constrain", run, "--sensors", 1, "--layout", "even", "--set", "budget.rays=4"],
        ["evaluate", run / "designs" / "fit.yaml", "--rays", 4],
    ):
        result = lidardesign(*command)
        assert (result.code, "z.stl: added after" in result.err) == (0, True), result.err
    opened = RunFolder.open(run)
    judged = with_task_settings(opened.task, opened.config, ["truth_points=200"])
    assert judged.task.inputs == opened.config.task.inputs
    again = LearnRequest.resolve("meshes", {"out": tmp_path / "again", "config": run / "config.yaml"})
    assert len(again.settings.task.inputs) == len(judged.task.inputs) + 3


def test_a_run_that_is_resumed_keeps_them_too(place, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(place / "run", run)
    come(place / "meshes")
    notes = []
    request = LearnRequest.resolve("meshes", {"out": run, "resume": True}, notes.append)
    assert request.settings.task.inputs == read_manifest(run)["inputs"]
    assert any("z.stl: added after" in note for note in notes)


def test_recordings_stay_on_their_side_too(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='turn'/><geom size='.1'/></body></worldbody></mujoco>"
    )
    folder = tmp_path / "walks"
    folder.mkdir()

    def record(name, seconds):
        np.savetxt(folder / name, [[0, 0], [seconds, 1]], delimiter=",", header="time_s,turn", comments="")

    record("b.csv", 1)
    record("d.csv", 2)
    config = MujocoConfig(motion=folder)
    config = config.model_copy(update={"inputs": input_hashes(config)})
    record("a.csv", 3)
    assert [one.name for one in read_recordings(model, folder, config)] == ["b.csv", "d.csv"]
    assert len(read_recordings(model, folder)) == 3
    (folder / "b.csv").unlink()
    with pytest.raises(DataError, match="is gone"):
        read_recordings(model, folder, config)


@pytest.mark.parametrize(("kind", "suffix"), [("folder", "stl"), ("motion", "csv")])
def test_equal_files_in_both_halves_are_named(tmp_path, kind, suffix):
    config = MeshesConfig if kind == "folder" else MujocoConfig
    files = [tmp_path / f"{letter}.{suffix}" for letter in "abcd"]
    held, other = ([one for one in files if (one in config(**{kind: tmp_path}).held_out(files)) == is_held]
                   for is_held in (True, False))  # fmt: skip

    def notes(*equal):
        inputs = {str(file): "same" if file in equal else file.name for file in files}
        return config(**{kind: tmp_path}, inputs=inputs).twin_notes()

    assert notes() == notes(*held) == notes(*other) == []
    assert f": {held[0].name} and {other[0].name}" in notes(held[0], other[0])[0]
