"""Everything that a user can get wrong: one clear message, the right exit code, and nothing half-written."""

from __future__ import annotations

import errno
import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from support.command_line import files_under, make_run
from support.mistakes import GARBAGE, GOOD, check_one_clear_message

from lidardesign.run.files import run_lock
from lidardesign.samples import load_samples, save_samples

CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
OPEN = CORNERS + "f 1 2 3\nf 1 2 4\n"
EMPTY_PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
)

# folder, file in it, its content
MESHES = [
    ("empty_obj", "a.obj", b""),
    ("empty_stl", "a.stl", b""),
    ("empty_ply", "a.ply", EMPTY_PLY),
    ("only_points", "a.obj", CORNERS.encode()),
    ("nan", "a.obj", OPEN.replace("v 1 0 0", "v nan 0 0").encode()),
    ("infinite", "a.obj", OPEN.replace("v 1 0 0", "v inf 0 0").encode()),
    ("missing_corner", "a.obj", (CORNERS + "f 1 2 9\n").encode()),
    ("open", "a.obj", OPEN.encode()),
    ("one_bad_of_two", "b.stl", GARBAGE),
    ("one_bad_of_two", "a.obj", OPEN.encode()),
    ("no_mesh", "a.txt", b"hello"),
    *((f"garbage_{suffix}", f"a.{suffix}", GARBAGE) for suffix in ("stl", "obj", "ply", "glb", "gltf", "off")),
]

TEXTS = {
    "typo.yaml": "density:\n  sigma_m: [0.01\n",
    "unknown.yaml": "density:\n  sigma_mm: 0.1\n",
    "type.yaml": "density: {sigma_m: wide}\n",
    "other_task.yaml": "task_name: face\n",
    "upside_down.yaml": "space: {range_m: [1.0, 0.5]}\n",
    "alias.yaml": "task:\n  targets: *hand\n",
    "garbage.yaml": "\x00\x01\x02",
    "design.yaml": "schema_version: 2\nsensors: 3\n",
    "gate.yaml": "gate: {width_m: {max: -1}}\n",
    "contradiction.yaml": "gate: {start_m: {min: 0.8}, end_m: {max: 0.5}}\n",
    "earlier.yaml": "schema_version: 1\nlayout: grid\nrays: 9\nsensors: []\n",
    "rays.yaml": GOOD.replace("rays: 100", "rays: many"),
    "notes.txt": "not a design at all",
    "rows.csv": "a,b,c\n1,2,3\n",
}

CASES = [
    # commands
    ("fly", 2, "fly"),
    ("learn", 2, "TASK"),
    ("learn nothing", 2, "unknown task 'nothing'"),
    ("learn flatland --unknown", 2, "unknown"),
    ("tasks remove", 2, "remove"),
    ("config init nothing", 2, "unknown task"),
    ("config init flatland --set colour=red", 2, "colour"),
    ("config schema recipe", 2, "config, constraints, design, evaluate"),
    ("config schema design --task face", 2, "--task"),
    # meshes
    ("learn meshes", 2, "--set folder=PATH"),
    ("learn meshes --set folder=absent", 3, "absent"),
    ("learn meshes --set folder=nothing", 3, "nothing"),
    ("learn meshes --set folder=no_mesh", 3, "no_mesh"),
    ("learn meshes --set folder=open --set sign=solid", 3, "a.obj"),
    ("learn meshes --set folder=open --set sign=inside", 2, "--set sign=inside"),
    ("learn meshes --set folder=one_bad_of_two", 3, "b.stl"),
    ("learn meshes --set folder=open --set occluders=garbage_stl", 3, "a.stl"),
    *(
        (f"learn meshes --set folder={name}", 3, file)
        for name, file, _ in MESHES
        if name not in ("open", "one_bad_of_two", "no_mesh")
    ),
    # configuration: file, line and column
    ("learn flatland --config absent.yaml", 2, "absent.yaml: cannot be read: No such file"),
    ("learn flatland --config typo.yaml", 2, "typo.yaml:3:1"),
    ("learn flatland --config unknown.yaml", 2, "unknown.yaml:2:3: unknown key 'density.sigma_mm'"),
    ("learn flatland --config type.yaml", 2, "type.yaml:1:20"),
    ("learn flatland --config other_task.yaml", 2, "other_task.yaml:1:"),
    ("learn flatland --config upside_down.yaml", 2, "upside_down.yaml:1:"),
    ("learn flatland --config open", 2, "open"),
    ("learn flatland --set sigma", 2, "KEY=VALUE"),
    ("learn flatland --set density.sigma_m=-1", 2, "--set density.sigma_m=-1"),
    ("learn flatland --set density.sigma_m=-1 --dry-run", 2, "--set density.sigma_m=-1"),
    ("learn flatland --out run --dry-run", 2, "not empty"),
    ("learn flatland --set learning.step=3", 2, "did you mean 'steps'"),
    ("learn flatland --set train=0", 2, "--set train=0"),
    ("learn flatland --set space.range_m=[2,1]", 2, "--set space.range_m=[2,1]"),
    ("learn flatland --preset quick", 2, "draft, standard, fine"),
    ("learn flatlan", 2, "did you mean 'flatland'"),
    ("learn flatland --device cuda:9", 2, "auto, cpu, cuda"),
    ("learn flatland --seed -1", 2, "seed"),
    # morphable models
    ("learn face --set model=absent.h5", 3, "absent.h5"),
    ("learn face --set model=text.h5", 3, "text.h5"),
    ("learn face --set model=other.h5", 3, "other.h5"),
    ("learn face --set model=truncated.h5", 3, "truncated.h5"),
    ("learn face --set model=open", 3, "open"),
    # runs
    ("fit open", 3, "not a run folder"),
    ("fit unfinished", 3, "--resume"),
    ("evaluate unfinished", 3, "no designs yet"),
    ("fit truncated", 3, "truncated"),
    ("fit flipped", 3, "SHA-256"),
    ("constrain flipped --set gate.width_m.max=0.3", 3, "SHA-256"),
    ("fit edited", 3, "config.yaml"),
    ("fit no_manifest", 3, "manifest.json"),
    ("fit bad_manifest", 3, "manifest.json"),
    ("fit newer", 3, "schema version"),
    ("learn flatland --out run", 2, "not empty"),
    ("learn flatland --out open", 2, "not empty"),
    ("learn flatland --out notes.txt", 2, "is a file"),
    ("learn flatland --out notes.txt/run", 3, "cannot be made"),
    ("learn flatland --resume --out absent", 3, "no run to resume"),
    ("learn flatland --resume --out open", 3, "not a run folder"),
    ("learn flatland --resume --out locked", 2, "is writing this run"),
    ("learn face --resume --out run", 2, "task"),
    # options
    ("fit run --rays 0", 2, "rays"),
    ("fit run --sensors 0", 2, "from 1 to 1000, best"),
    ("fit run --sensors 2.5", 2, "from 1 to 1000, best"),
    (f"fit run --sensors {'9' * 5000}", 2, "from 1 to 1000, best"),
    ("fit run --seed 9223372036854775808", 2, "seed"),
    ("fit run --layout spinning --channels 4000000000", 2, "--channels"),
    ("fit run --level 1", 2, "0.01 to 0.999999"),
    ("fit run --weight train=", 2, "train has no value"),
    ("fit run --weight train=many", 2, "--weight train=many"),
    ("fit run --rays 6000", 2, "1 to 5000"),
    ("fit run --layout spinning --channels 16 --rays 8", 2, "16 channels"),
    ("fit equal --layout even --sensors 2", 3, "its 1000 samples count as only 1"),
    ("fit elsewhere --layout even --sensors 2", 3, "belong to another design space: range_m"),
    ("fit millimetres --layout even --sensors 2", 3, "1000 of 1000 points outside"),
    ("fit run --parts , --sensors 1", 2, "has an empty part name"),
    ("fit run --modules 2 --fov 45x45", 2, "--zones"),
    ("fit run --modules 2 --fov 45x45 --zones 8x8 --sensors 2", 2, "without --sensors"),
    ("constrain run --modules 2 --fov wide --zones 8x8", 2, "--fov 45x45"),
    ("learn mujoco --set model=robot.xml --set targets=[*hand]", 2, 'in it, such as "*hand"'),
    ("learn mujoco --config alias.yaml", 2, 'in it, such as "*hand"'),
    ("learn arm --set frames=1000 --set train=10000", 2, "allowed: 200000 frames in all"),
    ("learn mujoco --set frames=1000 --set test=10000", 2, "test: 10000 scenes of 1000 frames"),
    ("fit run --layout spiral", 2, "chosen, even, spinning"),
    ("fit run --gates one", 2, "sensor, ray"),
    ("fit run --name ../elsewhere", 2, "not a name for a design"),
    ("fit run --sensors 5 --rays 3", 4, "3 rays for 5 sensors"),
    ("constrain run --sensors 5 --set budget.rays=3", 4, "budget.rays"),
    ("evaluate run --rays 0", 2, "rays"),
    ("evaluate run --fail-above inf", 2, "finite"),
    ("evaluate run", 3, "no designs yet"),
    ("evaluate absent", 3, "absent"),
    ("export", 2, "no design"),
    ("export good.yaml", 2, "no format"),
    ("export good.yaml --format jpeg", 2, "csv"),
    ("export good.yaml --format csv --out open", 3, "is a folder"),
    ("export good.yaml --format csv --out good.yaml", 2, "overwrite the design"),
    # constraints
    ("constrain run --constraints absent.yaml", 2, "absent.yaml"),
    ("constrain run --constraints gate.yaml", 2, "gate.yaml:1:23"),
    ("constrain run --constraints contradiction.yaml", 4, "gate."),
    ("constrain run --set mounts_m=[[0,0,1]]", 2, "did you mean 'origin.mounts_m'"),
    ("constrain run --set sensors.count=3 --sensors 2", 4, "sensors.count"),
    ("constrain run --set gate.start_m.min=7", 4, "gate.start_m.min"),
    ("constrain run --set origin.low_m=[5,0,0] --set origin.high_m=[6,0,0]", 4, "origin"),
    ("constrain run --set budget.bandwidth_mbps=1e-9", 4, "bandwidth_mbps"),
    ("constrain run --set gate.end_m.max=0.02", 4, "density"),
    # designs
    ("show absent.yaml", 3, "absent.yaml"),
    ("show notes.txt", 2, "notes.txt"),
    ("evaluate design.yaml", 2, "design.yaml:2:10"),
    ("export design.yaml --format csv", 2, "design.yaml"),
    *(
        (f"{command} earlier.yaml{further}", 2, "earlier.yaml:1:17: this design was written by an earlier version")
        for command, further in {
            "show": "",
            "evaluate": " --in run",
            "constrain": "",
            "fit run --like": "",
            "export": " --format csv",
        }.items()
    ),
    ("export rays.yaml --format csv", 2, "rays.yaml:2:30: budget.rays"),
    ("show rows.csv", 3, "rows.csv:1"),
    ("show garbage.yaml", 2, "garbage.yaml"),
    ("evaluate good.yaml --in run --baseline best", 2, "uniform"),
    ("evaluate good.yaml --in run --baseline none --fail-unless-better greedy", 2, "none alone"),
]


def damaged_run(folder, name, change):
    """A run with one of its files changed behind its back."""
    path = make_run(folder, count=1000) / name
    path.write_bytes(change(path.read_bytes()))


def flipped(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


def changed_samples(folder, change):
    """A run whose samples were replaced, with their hash."""
    samples = load_samples(make_run(folder, count=1000))
    save_samples(replace(samples, **change(samples)), folder)


def make_runs(folder):
    changed_samples(folder / "equal", lambda samples: {"points": np.tile(samples.points[:1], (1000, 1))})
    changed_samples(folder / "millimetres", lambda samples: {"points": 1000 * samples.points})
    changed_samples(
        folder / "elsewhere",
        lambda samples: {"space": replace(samples.space, high=(*samples.space.high[:5], 7.0))},
    )
    make_run(folder / "run", count=1000)
    damaged_run(folder / "truncated", "samples.npz", lambda content: content[: len(content) // 2])
    damaged_run(folder / "flipped", "samples.npz", flipped)
    damaged_run(folder / "edited", "config.yaml", lambda content: content.replace(b"seed: 3", b"seed: 4"))
    damaged_run(folder / "bad_manifest", "manifest.json", lambda content: content[:40])
    damaged_run(folder / "newer", "manifest.json", lambda c: c.replace(b'"schema_version": 1', b'"schema_version": 2'))
    make_run(folder / "no_manifest", count=1000)
    (folder / "no_manifest" / "manifest.json").unlink()
    make_run(folder / "locked", count=1000)
    unfinished = make_run(folder / "unfinished", count=1000)
    manifest = json.loads((unfinished / "manifest.json").read_text())
    del manifest["files"]["samples.npz"]
    (unfinished / "manifest.json").write_text(json.dumps(manifest))
    (unfinished / "samples.npz").unlink()


def make_models(folder):
    (folder / "text.h5").write_text("not HDF5")
    with h5py.File(folder / "other.h5", "w") as file:
        file["temperature"] = np.arange(5)
    content = (folder / "other.h5").read_bytes()
    (folder / "truncated.h5").write_bytes(content[: len(content) // 2])


@pytest.fixture(scope="module")
def mistakes(tmp_path_factory):
    """A folder with everything that can be got wrong in it."""
    folder = tmp_path_factory.mktemp("mistakes") / "with spaces ü"
    folder.mkdir()
    for name, file, content in MESHES:
        (folder / name).mkdir(exist_ok=True)
        (folder / name / file).write_bytes(content)
    (folder / "nothing").mkdir()
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    (folder / "good.yaml").write_text(GOOD)
    make_models(folder)
    make_runs(folder)
    with run_lock(folder / "locked"):
        yield folder


@pytest.mark.parametrize(("arguments", "code", "words"), CASES, ids=[case[0] for case in CASES])
def test_bad_input_gets_one_message_its_exit_code_and_writes_nothing(
    mistakes, lidardesign, monkeypatch, arguments, code, words
):
    monkeypatch.chdir(mistakes)
    before = files_under(mistakes)
    check_one_clear_message(lidardesign(*arguments.split(), "--json"), code, words)
    assert files_under(mistakes) == before
    assert not (mistakes / "runs").exists()


COMMANDS = {
    "fit": ("fit", "run", "--layout", "even", "--sensors", "1"),
    "constrain": ("constrain", "run", "--layout", "even", "--set", "budget.rays=20"),
    "export": ("export", "good.yaml", "--format", "npz", "--out", "rays.npz"),
    "learn": ("learn", "flatland", "--preset", "draft", "--out", "new/run"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_disk_that_takes_nothing_leaves_the_old_files(lidardesign, tmp_path, tmp_path_factory, monkeypatch, command):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path_factory.mktemp("kept")))
    make_run(tmp_path / "run", count=1000)
    (tmp_path / "good.yaml").write_text(GOOD)
    before = files_under(tmp_path)

    def refuse(source, target):
        raise OSError(errno.ENOSPC, "No space left on device", str(target))

    monkeypatch.setattr("lidardesign.run.files.os.replace", refuse)
    result = lidardesign(*COMMANDS[command], "--json")
    check_one_clear_message(result, 3, "No space left on device")
    assert files_under(tmp_path) == before
    assert not (tmp_path / "new").exists()
