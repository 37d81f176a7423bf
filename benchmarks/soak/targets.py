"""What is fuzzed: every kind of file that the program reads, through the function with which its commands read it.

And whole commands on damaged files: one message and an exit code of its own, and nothing half-written.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import re
import shutil
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from support.command_line import files_under, make_run
from support.docs_session import in_process

from benchmarks.soak import corpus
from benchmarks.soak.attempts import Read, Target, of_file
from benchmarks.soak.mutators import (
    either,
    mutate_bytes,
    mutate_folder,
    mutate_glb,
    mutate_hdf5,
    mutate_json,
    mutate_matlab,
    mutate_npz,
    mutate_text,
    mutate_yaml,
)  # fmt: skip
from lidardesign.config import SECTIONS, config_of, resolve
from lidardesign.constraints.document import load_constraints
from lidardesign.constraints.feasibility import check_feasible
from lidardesign.errors import InfeasibleError, LidardesignError
from lidardesign.run.yaml import dump_yaml, load_yaml, parse_yaml
from lidardesign.sensors.design_file import design_document, design_from_document, save_design
from lidardesign.task import load_task

MOST_FIRED = 5000


def read_configuration(path: Path) -> object:
    """As `learn --config` does, for the task that the file names."""
    document = load_yaml(path)
    named = document.mapping.get("task_name")
    task = named if named in corpus.TASKS else corpus.TASKS[zlib.crc32(path.read_bytes()) % len(corpus.TASKS)]
    if named == task and set(SECTIONS) <= set(document.mapping):
        return config_of(document)[1]
    return resolve(load_task(task), config_file=path)


def open_overrides(_: Path) -> Read:
    """As `--set` does, for a configuration or else for constraints."""

    def run(content: bytes) -> object:
        text = content.decode("utf-8", errors="replace")
        try:
            return resolve(load_task("flatland"), overrides=[text])
        except LidardesignError:
            return load_constraints(None, ["budget.rays=3", text])

    return run


@lru_cache(maxsize=1)
def _spaces() -> list[object]:
    return [resolve(load_task(name), preset="draft").space for name in ("flatland", "arm")]


def read_constraints(path: Path) -> object:
    """As `constrain --constraints` does, up to the check that any design can satisfy them."""
    constraints = load_constraints(path)
    parse_yaml(dump_yaml(constraints.as_document()), where="written again")
    refused = []
    for space in _spaces():
        try:
            check_feasible(constraints, space)
        except InfeasibleError as error:
            refused.append(error)
    if len(refused) == len(_spaces()):
        raise refused[0]
    return constraints


def read_design(path: Path) -> object:
    """As `show` and `export` do: what was read can be written and read again, and its rays are rays."""
    from lidardesign.formats.designs import load_design

    design = load_design(path)
    again = design_from_document(parse_yaml(dump_yaml(design_document(design)), where="written again").value)
    if len(again.sensors) != len(design.sensors):
        raise AssertionError("the design that was written again has another number of sensors")
    count = design.count or max(30, len(design.sensors))
    if max(count, len(design.sensors)) > MOST_FIRED:
        return design
    ends = [{design.condition: end} for end in design.patterns[-1].ends] if design.condition else [None]
    return design, [design.rays(count, at) for at in ends]


def _own(place: str, look: Callable = lambda found: found, *further: object) -> Callable[[Path], object]:
    """A function of the program, imported when it is called, and what is then looked at."""
    module, name = place.split(":")
    return lambda path: look(getattr(importlib.import_module(module), name)(path, *further))


read_detector = _own("lidardesign.simulate.detector.files:load_detector")
read_steering = _own("lidardesign.formats.galvo:read_galvo")
read_mesh = _own("lidardesign.scenes.mesh_files:load_mesh", lambda mesh: (mesh, mesh.bounds_m))
read_face = _own("lidardesign_tasks.basel:load_model", lambda model: (model, model.shape(model.modes[:, 0, 0] * 0)))
# true ranges may be NaN where nothing is
read_capture = _own(
    "lidardesign.evaluation.captures.capture:load_capture",
    lambda one: (replace(one, true_range_m=None), one.spacing_rad, one.background_per_bin),
)
read_model = _own("lidardesign.scenes.mujoco_models:load_model", lambda found: (found[0].nq, list(found[1])))
read_poses = _own(
    "lidardesign_tasks.poses:read_poses",
    lambda paths: {name: (one.time_s, one.at(np.linspace(-1.0, 3.0, 5))) for name, one in paths.items()},
)
read_part = _own("lidardesign.parts.catalogue:find_part")
read_robot = _own(
    "lidardesign_tasks.robot.arm_robot:load_robot", lambda robot: (robot.home_rad, robot.links), 0.15
)  # fmt: skip


def open_recordings(suffix: str) -> Callable[[Path], Read]:
    """As the task mujoco does with `motion`."""

    def opened(folder: Path) -> Read:
        import mujoco
        from lidardesign_tasks.robot.recordings import read_recordings

        model = mujoco.MjModel.from_xml_string(corpus.ROBOT)
        return of_file(suffix, lambda path: read_recordings(model, path))(folder)

    return opened


def open_fields(folder: Path) -> Read:
    """As `learn` does with its cache: what cannot be used is built again."""
    from lidardesign.density.fields.grids import _digest, _load

    read = of_file(".npy", lambda path: _load(path, 64))(folder)
    return lambda content: (read(content), read(content + _digest(content)))


def unpack(content: bytes, run: Path) -> None:
    """Make the files of a run; what is no archive any more is a run without files."""
    shutil.rmtree(run, ignore_errors=True)
    with contextlib.suppress(Exception), zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(run)


def open_run_folders(folder: Path) -> Read:
    """As `fit RUN`, `evaluate RUN` and `learn --resume` do, up to the scenes."""
    from lidardesign.api.scores import ScoreRequest
    from lidardesign.density.training.checkpoint import load_arrays, stored_snapshots
    from lidardesign.density.training.learned import seconds_at
    from lidardesign.samples import load_samples

    run = folder / "input_run"

    def read(content: bytes) -> object:
        unpack(content, run)
        request = ScoreRequest.resolve([run], {"rays": [9]})
        samples, arrays = load_samples(run), load_arrays(run, "checkpoint.safetensors")
        figures = (samples.points, samples.weights, samples.effective_sample_size)
        return request.rays, figures, request.run.command_times(), arrays, stored_snapshots(run), seconds_at(run)

    return read


TEXTS = either(mutate_text, mutate_text, mutate_bytes)
BINARY_TOO = either(mutate_bytes, mutate_text)
TARGETS = (
    Target("configuration (YAML)", 12_000, corpus.configurations, mutate_yaml, of_file(".yaml", read_configuration)),
    Target("--set", 5_000, corpus.overrides, TEXTS, open_overrides),
    Target("constraints (YAML)", 12_000, corpus.constraint_files, mutate_yaml, of_file(".yaml", read_constraints)),
    Target("design (YAML)", 14_000, corpus.design_files, mutate_yaml, of_file(".yaml", read_design)),
    Target("sensor table (CSV)", 8_000, corpus.sensor_tables, TEXTS, of_file(".csv", read_design)),
    Target("detector (YAML)", 6_000, corpus.detectors, mutate_yaml, of_file(".yaml", read_detector)),
    Target("mesh, STL", 5_000, corpus.meshes("stl"), BINARY_TOO, of_file(".stl", read_mesh)),
    Target("mesh, OBJ", 4_000, corpus.meshes("obj"), TEXTS, of_file(".obj", read_mesh)),
    Target("mesh, PLY", 4_000, corpus.meshes("ply"), BINARY_TOO, of_file(".ply", read_mesh)),
    Target("mesh, OFF", 2_000, corpus.meshes("off"), TEXTS, of_file(".off", read_mesh)),
    Target("mesh, GLB", 3_000, corpus.meshes("glb"), mutate_glb, of_file(".glb", read_mesh)),
    Target("mesh, glTF", 2_000, corpus.meshes("gltf"), mutate_json, of_file(".gltf", read_mesh)),
    Target("face model (HDF5)", 3_000, corpus.face_models, mutate_hdf5, of_file(".h5", read_face)),
    Target("capture (npz)", 3_000, corpus.captures_npz, mutate_npz, of_file(".npz", read_capture)),
    Target("capture (MATLAB 5)", 60, corpus.captures_matlab, mutate_matlab, of_file(".mat", read_capture)),
    Target("capture (MATLAB 7.3)", 1_500, corpus.captures_hdf5, mutate_hdf5, of_file(".mat", read_capture)),
    Target("steering list (CSV)", 2_000, corpus.steering_lists, TEXTS, of_file(".galvo.csv", read_steering)),
    Target("robot (MJCF)", 1_500, corpus.robots, TEXTS, of_file(".xml", read_robot)),
    Target("distance field (npy)", 250, corpus.distance_fields, mutate_bytes, open_fields),
    Target("rig (SDF)", 2_000, corpus.rigs("sdf"), TEXTS, of_file(".sdf", read_design)),
    Target("rig (MJCF)", 2_000, corpus.rigs("mjcf"), TEXTS, of_file(".xml", read_design)),
    Target("rig (CSV)", 3_000, corpus.rigs("csv"), TEXTS, of_file(".csv", read_design)),
    Target("rig (npz)", 2_500, corpus.rigs("npz"), mutate_npz, of_file(".npz", read_design)),
    Target("robot (MuJoCo)", 1_500, corpus.models, TEXTS, of_file(".xml", read_model)),
    Target("recording (CSV)", 1_500, corpus.recordings_csv, TEXTS, open_recordings(".csv")),
    Target("recording (npz)", 1_500, corpus.recordings_npz, mutate_npz, open_recordings(".npz")),
    Target("poses (CSV)", 1_500, corpus.poses, TEXTS, of_file(".csv", read_poses)),
    Target("part (YAML)", 4_000, corpus.part_files, mutate_yaml, of_file(".yaml", read_part)),
    Target("run folder", 8_000, corpus.run_folders, mutate_folder, open_run_folders),
)  # fmt: skip


# --- whole commands


KNOWN_CODES = (0, 1, 2, 3, 4, 5, 6)
NUMERICAL = 5
LONGEST_MESSAGE = 30


class RefusedError(LidardesignError):
    """A command that said what is wrong; `place` is its message without numbers."""

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.place = re.sub(r"[\d.'\"]+|input\S*", "#", message)[:80]


def checked(words: str, kept: Path) -> None:
    """Run a command; what it must not do is an AssertionError, what it refuses a `RefusedError`.

    Arguments:
        words: The command.
        kept: A folder that stays as it is when the command refuses its input.
    """
    before = files_under(kept)
    ran = in_process(words.split())
    text = f"exit code {ran.code}\n{ran.err[-3000:]}"
    if ran.code not in KNOWN_CODES or "Traceback" in ran.err or "Warning" in ran.err:
        raise AssertionError(text)
    if ran.code == 0:
        if "NaN" in ran.out or "Infinity" in ran.out:
            raise AssertionError(f"not finite: {ran.out[:500]}")
        return
    said = re.search(r"^\w+ error: .+", ran.err, re.MULTILINE)
    if not said or len(ran.err.splitlines()) > LONGEST_MESSAGE:
        raise AssertionError(f"no short message: {text}")
    changed = {name for name, content in files_under(kept).items() if before.get(name) != content}
    # what diverged while it was learned leaves its last good state
    if changed and ran.code != NUMERICAL:
        raise AssertionError(f"{', '.join(sorted(changed))} was written: {text}")
    raise RefusedError(said[0])


def command(words: str, place: str = "input.yaml") -> Callable[[Path], Read]:
    """A reader that hands the input to a command.

    Beside it are a run `run`, a design `good.yaml` and a capture `good.npz`.

    Arguments:
        words: The command; `learn` gets its settings besides.
        place: Where the input lies; a run is unpacked there.
    """
    if words.startswith("learn") and "--resume" not in words:
        words += " --preset draft --out input_out" + "".join(f" --set {value}" for value in corpus.SMALL)

    def opened(folder: Path) -> Read:
        make_run(folder / "run", count=1000)
        save_design(corpus.sample_designs()[0], folder / "good.yaml")
        (folder / "good.npz").write_bytes(corpus.captures_npz(folder)[0])
        (folder / place).parent.mkdir(exist_ok=True)

        def read(content: bytes) -> None:
            shutil.rmtree(folder / "input_out", ignore_errors=True)
            if place == "input_run":
                unpack(content, folder / place)
            else:
                (folder / place).write_bytes(content)
            checked(words, folder)

        return read

    return opened


DESIGNS = corpus.design_files
LEARN_MESHES = "learn meshes --set folder=input_folder --set poses=1 --json"
LEARN_MUJOCO = "learn mujoco --set model=input.xml --set targets=[hand] --set train=2 --set test=2 --json"
CONSTRAIN = "constrain run --layout even --constraints input.yaml --name made --json"
COMMANDS = tuple(
    # learning takes a while: a command may take so much processor time [s]
    Target(name, share, seeds, mutate, command(*words), slow_s=60.0, batch=60)
    for name, share, seeds, mutate, *words in (
        ("show DESIGN", 30, DESIGNS, mutate_yaml, "show input.yaml --json"),
        ("export DESIGN", 50, DESIGNS, mutate_yaml,
         "export input.yaml --format csv --out input_out/rays.csv --json"),
        ("constrain --constraints", 50, corpus.constraint_files, mutate_yaml, CONSTRAIN),
        ("evaluate --detector", 40, corpus.detectors, mutate_yaml,
         "evaluate good.yaml --in run --detector input.yaml --rays 20 --json"),
        ("capture FILE", 30, corpus.captures_npz, mutate_npz,
         "capture input.npz good.yaml --rays 20 --json", "input.npz"),
        ("learn --config", 30, corpus.configurations, mutate_yaml, "learn flatland --config input.yaml --json"),
        ("learn meshes", 35, corpus.meshes("glb"), mutate_glb, LEARN_MESHES, "input_folder/input.glb"),
        ("learn mujoco", 20, corpus.models, TEXTS, LEARN_MUJOCO, "input.xml"),
        ("learn face", 10, corpus.face_models, mutate_hdf5,
         "learn face --set model=input.h5 --set train=2 --set test=2 --json", "input.h5"),
        ("learn --resume", 100, corpus.run_folders, mutate_folder,
         "learn flatland --resume --out input_run --json", "input_run"),
        ("fit RUN", 50, corpus.run_folders, mutate_folder,
         "fit input_run --layout even --json --name made", "input_run"),
        ("fit --like RIG", 40, corpus.rigs("mjcf"), TEXTS,
         "fit run --like input.xml --layout even --name made --json", "input.xml"),
    )
)  # fmt: skip
EVERY = {target.name: target for target in (*TARGETS, *COMMANDS)}
