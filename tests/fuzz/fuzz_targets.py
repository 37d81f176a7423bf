"""What is fuzzed: every kind of file that the program reads, through the function with which its commands read it."""

from __future__ import annotations

import importlib
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from fuzz import corpus, fuzz_rigs
from fuzz.attempts import Read, Target, of_file
from fuzz.containers import mutate_glb, mutate_gltf, mutate_hdf5, mutate_matlab, mutate_npz, mutate_safetensors
from fuzz.fuzz_runs import (
    checkpoints,
    open_checkpoints,
    open_fields,
    open_manifests,
    open_progress,
    open_samples,
)  # fmt: skip
from fuzz.mutators import either, mutate_bytes, mutate_json, mutate_text, mutate_yaml

MOST_FIRED = 5000


def read_configuration(path: Path) -> object:
    """As `learn --config` does, for the task that the file names."""
    from lidardesign.config import SECTIONS, config_of, resolve
    from lidardesign.registry import load_task
    from lidardesign.run.yaml import load_yaml

    document = load_yaml(path)
    named = document.mapping.get("task_name")
    task = named if named in corpus.TASKS else corpus.TASKS[zlib.crc32(path.read_bytes()) % len(corpus.TASKS)]
    if named == task and set(SECTIONS) <= set(document.mapping):
        return config_of(document)[1]
    return resolve(load_task(task), config_file=path)


def open_overrides(_: Path) -> Read:
    """As `--set` does, for a configuration and for constraints."""
    from lidardesign.config import resolve
    from lidardesign.constraints.document import load_constraints
    from lidardesign.errors import LidardesignError
    from lidardesign.registry import load_task

    def configured(text: str) -> object:
        return resolve(load_task("flatland"), overrides=[text])

    def constrained(text: str) -> object:
        return load_constraints(None, ["budget.rays=3", text])

    def run(content: bytes) -> object:
        text = content.decode("utf-8", errors="replace")
        for read in (configured, constrained):
            try:
                return read(text)
            except LidardesignError as error:
                refused = error
        raise refused

    return run


@lru_cache(maxsize=1)
def _spaces() -> list[object]:
    from lidardesign.config import resolve
    from lidardesign.registry import load_task

    return [resolve(load_task(name), preset="draft").space for name in ("flatland", "arm")]


def read_constraints(path: Path) -> object:
    """As `constrain --constraints` does, up to the check that any design can satisfy them."""
    from lidardesign.constraints.document import load_constraints
    from lidardesign.constraints.feasibility import check_feasible
    from lidardesign.errors import InfeasibleError
    from lidardesign.run.yaml import dump_yaml, parse_yaml

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
    from lidardesign.run.yaml import dump_yaml, parse_yaml
    from lidardesign.sensors.design_file import design_document, design_from_document

    design = load_design(path)
    again = design_from_document(parse_yaml(dump_yaml(design_document(design)), where="written again").value)
    if len(again.sensors) != len(design.sensors):
        raise AssertionError("the design that was written again has another number of sensors")
    count = design.count or max(30, len(design.sensors))
    if max(count, len(design.sensors)) > MOST_FIRED:
        return design
    ends = [{design.condition: end} for end in design.patterns[-1].ends] if design.condition else [None]
    return design, [design.rays(count, at) for at in ends]


def _own(place: str) -> Callable[[Path], object]:
    """A function of the program, imported when it is called."""
    module, name = place.split(":")
    return lambda path: getattr(importlib.import_module(f"lidardesign.{module}"), name)(path)


read_detector = _own("simulate.detector.files:load_detector")
read_steering = _own("formats.galvo:read_galvo")


def read_mesh(path: Path) -> object:
    """As the task meshes does."""
    from lidardesign.scenes.mesh_files import load_mesh

    mesh = load_mesh(path)
    return mesh, mesh.bounds_m


def read_face(path: Path) -> object:
    """As the task face does."""
    from lidardesign_tasks.basel import load_model

    model = load_model(path)
    return model, model.shape(model.modes[:, 0, 0] * 0)


def read_capture(path: Path) -> object:
    """As `capture` does; true ranges may be NaN where nothing is."""
    from lidardesign.scoring.captures.capture import load_capture

    capture = load_capture(path)
    return replace(capture, true_range_m=None), capture.spacing_rad, capture.background_per_bin


def read_robot(path: Path) -> object:
    """As the task arm does."""
    from lidardesign_tasks.robot.arm_robot import load_robot

    robot = load_robot(path, 0.15)
    return robot.home_rad, robot.links


def _meshes(kind: str) -> Callable[[Path], list[bytes]]:
    return lambda _: corpus.mesh_exports(kind)


TEXTS = either(mutate_text, mutate_text, mutate_bytes)
TARGETS = (
    Target("configuration (YAML)", 12_000, corpus.configurations, mutate_yaml, of_file(".yaml", read_configuration)),
    Target("--set", 5_000, corpus.overrides, TEXTS, open_overrides),
    Target("constraints (YAML)", 12_000, corpus.constraint_files, mutate_yaml, of_file(".yaml", read_constraints)),
    Target("design (YAML)", 14_000, corpus.design_files, mutate_yaml, of_file(".yaml", read_design)),
    Target("sensor table (CSV)", 8_000, corpus.sensor_tables, TEXTS, of_file(".csv", read_design)),
    Target("detector (YAML)", 6_000, corpus.detectors, mutate_yaml, of_file(".yaml", read_detector)),
    Target("mesh, STL", 5_000, _meshes("stl"), either(mutate_bytes, mutate_text), of_file(".stl", read_mesh)),
    Target("mesh, OBJ", 4_000, _meshes("obj"), TEXTS, of_file(".obj", read_mesh)),
    Target("mesh, PLY", 4_000, _meshes("ply"), either(mutate_bytes, mutate_text), of_file(".ply", read_mesh)),
    Target("mesh, OFF", 2_000, _meshes("off"), TEXTS, of_file(".off", read_mesh)),
    Target("mesh, GLB", 3_000, _meshes("glb"), mutate_glb, of_file(".glb", read_mesh)),
    Target("mesh, glTF", 2_000, _meshes("gltf"), either(mutate_gltf, mutate_json), of_file(".gltf", read_mesh)),
    Target("face model (HDF5)", 3_000, corpus.face_models, mutate_hdf5, of_file(".h5", read_face)),
    Target("capture (npz)", 3_000, corpus.captures_npz, mutate_npz, of_file(".npz", read_capture)),
    Target("capture (MATLAB 5)", 60, corpus.captures_matlab, mutate_matlab, of_file(".mat", read_capture)),
    Target("capture (MATLAB 7.3)", 1_500, corpus.captures_hdf5, mutate_hdf5, of_file(".mat", read_capture)),
    Target("steering list (CSV)", 2_000, corpus.steering_lists, TEXTS, of_file(".galvo.csv", read_steering)),
    Target("robot (MJCF)", 1_500, corpus.robots, TEXTS, of_file(".xml", read_robot)),
    Target("manifest (JSON)", 2_500, corpus.manifests, mutate_json, open_manifests),
    Target("samples (npz)", 1_500, corpus.samples, mutate_npz, open_samples),
    Target("checkpoint (safetensors)", 1_500, checkpoints, mutate_safetensors, open_checkpoints),
    Target("progress (JSON lines)", 500, corpus.progresses, TEXTS, open_progress),
    Target("distance field (npy)", 250, corpus.distance_fields, mutate_bytes, open_fields),
    Target("rig (SDF)", 2_000, fuzz_rigs.rigs("sdf"), TEXTS, of_file(".sdf", read_design)),
    Target("rig (MJCF)", 2_000, fuzz_rigs.rigs("mjcf"), TEXTS, of_file(".xml", read_design)),
    Target("rig (CSV)", 3_000, fuzz_rigs.rigs("csv"), TEXTS, of_file(".csv", read_design)),
    Target("rig (npz)", 2_500, fuzz_rigs.rigs("npz"), mutate_npz, of_file(".npz", read_design)),
    Target("robot (MuJoCo)", 1_500, fuzz_rigs.models, TEXTS, of_file(".xml", fuzz_rigs.read_model)),
    Target("recording (CSV)", 1_500, fuzz_rigs.recordings_csv, TEXTS, fuzz_rigs.open_recordings(".csv")),
    Target("recording (npz)", 1_500, fuzz_rigs.recordings_npz, mutate_npz, fuzz_rigs.open_recordings(".npz")),
    Target("poses (CSV)", 1_500, fuzz_rigs.poses, TEXTS, of_file(".csv", fuzz_rigs.read_motion)),
    Target("part (YAML)", 4_000, fuzz_rigs.part_files, mutate_yaml, of_file(".yaml", fuzz_rigs.read_part_file)),
    Target("run folder", 1_500, fuzz_rigs.run_folders, fuzz_rigs.mutate_folder, fuzz_rigs.open_run_folders),
)
NAMES = tuple(target.name for target in TARGETS)


def target_of(name: str) -> Target:
    """The target of a name."""
    return TARGETS[NAMES.index(name)]
