"""What scenes show of a pool of rays, kept in the run: read as it is found, and made anew where it would differ."""

from __future__ import annotations

import importlib.util
import io
import shutil
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from support.command_line import make_run
from support.conditioned_runs import make_conditioned_run
from support.mesh_runs import make_mesh_run

from lidardesign.api.run import open_run
from lidardesign.config import resolve
from lidardesign.rays import pool
from lidardesign.rays.pool import FILE_NAME, pool_of
from lidardesign.rays.training_scenes import SceneInformation, TrainingScenes
from lidardesign.run_folder import RunFolder
from lidardesign.samples import load_samples, save_samples
from lidardesign.sensors.design_file import design_document


@pytest.fixture(autouse=True, scope="module")
def few_scenes():
    with pytest.MonkeyPatch.context() as patch:
        for name in ("rays.information", "rays.training_scenes", "rays.selection", "fitting.chosen", "fitting.trials"):
            patch.setattr(f"lidardesign.{name}.FEW_SCENES", 3)
        yield


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A run without a pool, and beside it one whose pool was found."""
    place = tmp_path_factory.mktemp("runs")
    run = make_mesh_run(place / "run", count=1500)
    shutil.copytree(run, place / "found")
    found(place / "found")
    return run, place / "found"


@pytest.fixture
def run(learned, tmp_path):
    """A copy of the run whose pool was found."""
    return shutil.copytree(learned[1], tmp_path / "run")


def found(folder, seed=3, **changes):
    """The pool of a run, and the steps that it took to find it: none where it was read."""
    steps, opened = [], replace(RunFolder.open(folder), **changes)
    return pool_of(opened, load_samples(folder), TrainingScenes(opened, seed), steps.append), steps


def bits(kept):
    """All that a pool holds, to the bit and with its types."""
    scenes = [
        getattr(scene, one.name) for scene in (*kept.informed, *kept.held_back) for one in fields(SceneInformation)
    ]
    arrays = [np.asarray(value) for value in (kept.points, *scenes)]
    return [*((array.dtype, array.shape, array.tobytes()) for array in arrays), kept.visits, len(kept.informed)]


def test_what_is_read_is_bit_for_bit_what_is_found_without_it(run, learned):
    alone = found(shutil.copytree(learned[0], run.parent / "alone"))
    read = found(run)
    assert bits(read[0]) == bits(alone[0])
    assert alone[1] != []
    assert read[1] == []


def test_a_run_whose_density_has_a_condition_has_a_pool_of_rays_at_each_of_its_values(tmp_path):
    run = make_conditioned_run(tmp_path / "run", count=1500)
    first, steps = found(run)
    again, none = found(run)
    assert (len(steps) > 0, none) == (True, [])
    assert bits(first) == bits(again)
    conditions = RunFolder.open(run).conditions()
    assert len(first.visits) == len(conditions) > 1
    for visit, at in zip(first.visits, conditions, strict=True):
        assert (first.points[visit, 0] == at["x_m"]).all()


def test_where_origins_are_free_the_candidates_of_the_last_fit_are_kept(tmp_path):
    free = make_run(tmp_path / "free", count=1000)
    bare = shutil.copytree(free, tmp_path / "bare")
    budget = {"budget": {"bandwidth_mbps": 0.4}}
    open_run(free).fit(sensors=1, rays=16)
    kept = (free / FILE_NAME).read_bytes()
    within, alone = (open_run(run).fit(sensors=1, rays=16, constraints=budget) for run in (free, bare))
    assert (free / FILE_NAME).read_bytes() == kept
    fired = [(design.rays(16).direction.tobytes(), design.rays(16).gate_m.tobytes()) for design in (within, alone)]
    assert fired[0] == fired[1]
    open_run(free).fit(sensors=2, rays=16)
    assert (free / FILE_NAME).read_bytes() != kept


def configured(folder, setting):
    opened = RunFolder.open(folder)
    kept = [f"task.folder={opened.config.task.folder}", "task.poses=4", "task.truth_points=100"]
    return {"config": resolve(opened.task, preset="draft", seed=3, overrides=[*kept, setting])}


@pytest.mark.parametrize(
    "change",
    ["setting of the task", "setting of the density", "input file", "new input file", "samples", "seed", "version"],
)
def test_what_the_pool_follows_from_is_noticed_where_it_changes(change, tmp_path, monkeypatch):
    run = make_mesh_run(tmp_path / "run", count=1500)
    before, _ = found(run)
    meshes, options, own = tmp_path / "balls", {}, RunFolder.open(run).config
    if change == "setting of the task":
        options = configured(run, "task.jitter_rotation_deg=20")
    elif change == "setting of the density":
        options = configured(run, "density.sigma_m=0.2")
    elif change == "input file":
        content = bytearray((meshes / "0.stl").read_bytes())
        content[90] ^= 1
        (meshes / "0.stl").write_bytes(content)
    elif change == "new input file":
        shutil.copy(meshes / "0.stl", meshes / "2.stl")
    elif change == "samples":
        samples = load_samples(run)
        save_samples(samples.subset(np.arange(len(samples) - 1)), run)
    elif change == "seed":
        options = {"seed": 4}
    else:
        monkeypatch.setattr("lidardesign.run.manifest.__version__", "0.0.0-other")
    after, steps = found(run, **options)
    assert steps
    if change in ("setting of the task", "new input file", "samples", "seed"):
        assert bits(after) != bits(before)
    # it is kept again, and what was before is noticed in turn
    again, none = found(run, **options)
    assert (none, bits(again)) == ([], bits(after))
    if options:
        back, steps = found(run, config=own)
        assert bits(back) == bits(before)
        assert steps


def test_a_change_of_the_tasks_own_source_is_noticed(run, tmp_path):
    path = tmp_path / "plugin" / "own_task.py"
    path.parent.mkdir()
    path.write_text("from lidardesign_tasks.meshes import MeshesTask\n\n\nclass OwnTask(MeshesTask):\n    pass\n")
    spec = importlib.util.spec_from_file_location("own_task", path)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "own_task", module)
        spec.loader.exec_module(module)
        task = module.OwnTask()
        assert found(run, task=task)[1]
        assert not found(run, task=task)[1]
        path.write_text(path.read_text() + "\n")
        assert found(run, task=task)[1]


def archive(content, *keys):
    """A file of arrays that holds some of those of a pool."""
    file = io.BytesIO()
    with np.load(io.BytesIO(content)) as arrays:
        np.savez(file, further=np.zeros(3), **{name: arrays[name] for name in keys})
    return file.getvalue()


DAMAGES = {
    "empty": lambda content: b"",
    "all but its end": lambda content: content[:-1],
    "a bit": lambda content: bytes([*content[:-4000], content[-4000] ^ 4, *content[-3999:]]),
    "other arrays": archive,
    "its key alone": lambda content: archive(content, "key"),
    "half of its arrays": lambda content: archive(content, "key", "ray"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_or_half_written_file_is_made_anew(damage, run):
    before = (run / FILE_NAME).read_bytes()
    expected, _ = found(run)
    (run / FILE_NAME).write_bytes(DAMAGES[damage](before))
    kept, steps = found(run)
    assert steps
    assert bits(kept) == bits(expected)
    assert (run / FILE_NAME).read_bytes() == before


def test_where_it_cannot_be_kept_it_costs_time_alone(run):
    expected, _ = found(run)
    (run / FILE_NAME).unlink()
    # nobody, not even root, writes a file over a folder
    (run / FILE_NAME).mkdir()
    for _ in range(2):
        kept, steps = found(run)
        assert steps
        assert bits(kept) == bits(expected)


@pytest.mark.parametrize("spare", [0, -1])
def test_it_is_kept_up_to_its_largest_size(spare, run, monkeypatch):
    size = (run / FILE_NAME).stat().st_size
    (run / FILE_NAME).unlink()
    monkeypatch.setattr(pool, "MOST_BYTES", size + spare)
    found(run)
    assert (run / FILE_NAME).is_file() == (spare == 0)


def document(folder):
    return design_document(open_run(folder).fit(sensors=2, rays=16, gates="ray").specification)


BANDWIDTH = {"sensors": 2, "rays": 16, "constraints": {"budget": {"bandwidth_mbps": 0.2, "bin_ps": 900.0}}}
# another number, other bins, and sensors that may be idle
BEFORE = (
    {"sensors": 1, "rays": 30, "constraints": {"gate": {"end_m": {"max": 3.0}}}},
    BANDWIDTH,
    {"sensors": "best", "rays": 16},
)


@pytest.mark.parametrize("kind", ["given", "free"])
def test_bytes_of_designs_depend_neither_on_what_is_kept_nor_on_earlier_fits(kind, learned, tmp_path):
    origin = learned[0] if kind == "given" else make_run(tmp_path / "origin", count=1000)
    expected = document(shutil.copytree(origin, tmp_path / "fresh"))
    assert document(tmp_path / "fresh") == expected
    used = shutil.copytree(origin, tmp_path / "used")
    for before in BEFORE if kind == "given" else BEFORE[:2]:
        open_run(used).fit(**before)
        assert (used / FILE_NAME).exists()
        assert document(used) == expected


def test_other_gates_and_bandwidths_of_the_same_candidates_are_chosen_without_casting_again(tmp_path):
    run = open_run(make_run(tmp_path / "free", count=1000))
    for steps, options in (([], {}), ([], {"gates": "ray"}), ([], BANDWIDTH)):
        run.fit(**{"sensors": 2, "rays": 16, **options}, progress=lambda step, *_, told=steps: told.append(str(step)))
        assert any("finding out" in step for step in steps) == (not options)
