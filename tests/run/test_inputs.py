"""Input files of every kind: what is not a regular file is not waited for, and what is too large is not read."""

from __future__ import annotations

import os
import re
import signal
import socket
import time
from contextlib import contextmanager
from pathlib import Path

import pytest
from lidardesign_tasks.basel import load_model
from lidardesign_tasks.poses import read_poses

from lidardesign.config import load_run_config
from lidardesign.density.training.checkpoint import load_arrays
from lidardesign.errors import ConfigError, DataError
from lidardesign.evaluation.captures.capture import load_capture
from lidardesign.formats.designs import load_design
from lidardesign.formats.galvo import read_galvo
from lidardesign.formats.ray_lists import read_ray_csv, read_sensor_csv
from lidardesign.parts.catalogue import read_part
from lidardesign.run import inputs
from lidardesign.run.arrays import read_npz
from lidardesign.run.files import FILE_NAME, run_lock, sha256_file, write_atomic
from lidardesign.run.manifest import read_manifest
from lidardesign.run.xml import read_xml
from lidardesign.run.yaml import load_yaml
from lidardesign.scenes.mesh_files import SUFFIXES, list_mesh_files, load_mesh
from lidardesign.scenes.mujoco_models import model_files
from lidardesign.simulate.detector.files import load_detector

DOCS = Path(__file__).parents[2] / "docs" / "formats.md"
PATIENCE_S = 5
READERS = [
    ("a.yaml", load_yaml, inputs.YAML),
    ("detector.yaml", load_detector, inputs.YAML),
    ("part.yaml", read_part, inputs.YAML),
    ("design.yaml", load_design, inputs.RAY_TABLE),
    ("rays.csv", load_design, inputs.RAY_TABLE),
    ("rays.csv", read_ray_csv, inputs.RAY_TABLE),
    ("sensors.csv", read_sensor_csv, inputs.RAY_TABLE),
    ("galvo.csv", read_galvo, inputs.RAY_TABLE),
    ("poses.csv", read_poses, inputs.TABLE),
    ("arrays.npz", read_npz, inputs.ARRAYS),
    ("capture.npz", load_capture, inputs.CAPTURE),
    ("capture.mat", load_capture, inputs.CAPTURE),
    ("head.h5", load_model, inputs.HEAD_MODEL),
    ("robot.xml", model_files, inputs.XML),
    ("rig.sdf", lambda path: read_xml(path, "SDF"), inputs.XML),
    ("hash.bin", sha256_file, inputs.STATE),
    *((f"mesh{suffix}", load_mesh, inputs.MESH) for suffix in SUFFIXES),
]


@contextmanager
def an_alarm():
    """Fail where something is waited for, instead of waiting for ever."""
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waited for what never comes"))
    signal.alarm(PATIENCE_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def make_pipe(path):
    os.mkfifo(path)


def make_socket(path):
    here = os.getcwd()
    os.chdir(path.parent)  # names of sockets are short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def make_device(path):
    path.symlink_to("/dev/zero")


def make_folder(path):
    path.mkdir()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize(
    ("name", "read", "make"),
    [(name, read, make) for name, read, _ in READERS for make in (make_pipe, make_socket, make_device, make_folder)],
)
def test_what_is_no_regular_file_is_refused_by_its_name_without_waiting(tmp_path, name, read, make):
    path = tmp_path / name
    make(path)
    with an_alarm(), pytest.raises((ConfigError, DataError)) as refused:
        read(path)
    assert str(path) in str(refused.value) or str(path.resolve()) in str(refused.value)
    assert re.search("not a regular file|folder", str(refused.value))


@pytest.mark.parametrize(("name", "read", "kind"), READERS)
def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path, name, read, kind):
    with (tmp_path / name).open("wb") as file:
        file.truncate(kind.most_bytes + 1)
    started = time.perf_counter()
    with pytest.raises((ConfigError, DataError), match="too large") as refused:
        read(tmp_path / name)
    assert inputs.size_text(kind.most_bytes) in str(refused.value)
    assert time.perf_counter() - started < 1.0


@pytest.mark.parametrize(("name", "read"), [(name, read) for name, read, _ in READERS])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, name, read):
    for path in (tmp_path / f"{'x' * 300}{name}", tmp_path.joinpath(*["y" * 200] * 30, name)):
        with pytest.raises((ConfigError, DataError)):
            read(path)


@pytest.mark.parametrize("name", ["manifest.json", "config.yaml", "checkpoint.safetensors"])
def test_a_pipe_in_a_run_is_refused_without_waiting(tmp_path, name):
    read = {
        "manifest.json": read_manifest,
        "config.yaml": load_run_config,
        "checkpoint.safetensors": lambda run: load_arrays(run, name),
    }
    os.mkfifo(tmp_path / name)
    with an_alarm(), pytest.raises((ConfigError, DataError)):
        read[name](tmp_path)


def test_the_documentation_lists_the_limits():
    text = DOCS.read_text(encoding="utf-8")
    for kind in inputs.KINDS:
        unpacked = "" if kind.unpacked_bytes is None else inputs.size_text(kind.unpacked_bytes)
        assert f"| {kind.name} | {inputs.size_text(kind.most_bytes)} | {unpacked} |" in text


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
@pytest.mark.parametrize("make", [make_pipe, make_socket, make_folder, make_device])
def test_a_lock_that_is_no_file_is_refused_and_nothing_behind_it_is_touched(tmp_path, make):
    make(tmp_path / FILE_NAME)
    with an_alarm(), pytest.raises(DataError, match="not a regular file"), run_lock(tmp_path):
        pytest.fail("the lock is no lock")
    assert os.path.lexists(tmp_path / FILE_NAME)


@pytest.mark.parametrize("there", [True, False])
def test_a_lock_that_is_a_link_neither_empties_nor_makes_what_it_names(tmp_path, there):
    target = tmp_path / "precious"
    if there:
        target.write_text("precious")
    (tmp_path / FILE_NAME).symlink_to(target)
    with pytest.raises(DataError, match="not a regular file"), run_lock(tmp_path):
        pytest.fail("the lock is no lock")
    assert (target.read_text() == "precious") if there else not target.exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_that_nobody_reads_is_not_written_to(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with an_alarm(), pytest.raises(DataError, match="cannot be written"):
        write_atomic(tmp_path / "pipe", b"x")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_or_a_broken_link_among_meshes_is_not_left_out_in_silence(tmp_path):
    os.mkfifo(tmp_path / "a.obj")
    (tmp_path / "b.obj").symlink_to(tmp_path / "nowhere.obj")
    for path in list_mesh_files(tmp_path):
        with an_alarm(), pytest.raises(DataError, match=r"not a regular file|No such file"):
            load_mesh(path)
    assert len(list_mesh_files(tmp_path)) == 2
