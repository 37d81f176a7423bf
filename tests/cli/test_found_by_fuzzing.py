"""What damaged files once did to the program: each ends in words now."""

from __future__ import annotations

import errno
import json
import math
import struct
import sys
import zipfile

import numpy as np
import pytest
from lidardesign_tasks.robot.arm_robot import load_robot
from support.captures import make_capture
from support.command_line import make_run
from support.mistakes import GOOD

from lidardesign.cli.terminal.output import Output, describe_error
from lidardesign.constraints.document import MOST_FITTED, Constraints
from lidardesign.density.fields.grids import _digest, _load
from lidardesign.density.training.learned import seconds_at
from lidardesign.density.training.trainer import _step_of
from lidardesign.errors import ConfigError, DataError
from lidardesign.formats.designs import load_design
from lidardesign.mixture.fit import FitProblem, fit_sensors
from lidardesign.run.manifest import record
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.mesh_files import check_mesh, load_mesh
from lidardesign.scoring.captures.capture import load_capture
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.sensor import MOST_RAYS
from lidardesign.space import FARTHEST_M, DesignSpace

SPACE = DesignSpace((0.0, 0, 0, 2, 0, 0), (1.0, 0, 0, 4, 0, 1))
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


# --- samples of a run


def good_arrays():
    space = np.frombuffer(json.dumps(SPACE.as_dict()).encode(), dtype=np.uint8)
    points = np.tile(np.clip(1.0, SPACE.low, SPACE.high), (9, 1))
    return {"points": points, "log_prob": np.zeros(9), "log_target": np.zeros(9), "space": space}


BAD_SAMPLES = {
    "no archive": (b"words", "is not an .npz file"),
    "cut short": (lambda content: content[:-30], "is not an .npz file"),
    "a wrong checksum": (lambda content: content.replace(struct.pack("<d", 1.0), struct.pack("<d", 2.0), 1), "CRC"),
    "one array missing": ({"log_target": None}, "has no log_target"),
    "another type": ({"log_prob": np.array(["a"] * 9)}, "of type <U1"),
    "whole numbers": ({"log_prob": np.zeros(9, np.int64)}, "int64 of shape"),
    "another shape": ({"points": np.ones((9, 5))}, "shape \\(9, 5\\)"),
    "another length": ({"log_prob": np.zeros(8)}, "shape \\(8,\\)"),
    "no sample": ({"points": np.ones((0, 6)), "log_prob": np.zeros(0), "log_target": np.zeros(0)}, "shape \\(0, 6\\)"),
    "a number alone": ({"points": np.array(1.0)}, "shape \\(\\)"),
    "infinite targets": ({"log_target": np.full(9, np.inf)}, "not finite"),
    "an infinite azimuth": ({"points": good_arrays()["points"] + [0, 0, 0, np.inf, 0, 0]}, "not finite"),
    "no space": ({"space": np.frombuffer(b"[1, 2]", np.uint8)}, "TypeError"),
    "a space of words": ({"space": np.frombuffer(b"{", np.uint8)}, "JSONDecodeError"),
}


@pytest.mark.parametrize("case", BAD_SAMPLES)
def test_samples_that_are_none_are_refused_although_their_hash_is_right(tmp_path, case):
    run = make_run(tmp_path / "run", count=20)
    change, words = BAD_SAMPLES[case]
    arrays = {**good_arrays(), **(change if isinstance(change, dict) else {})}
    np.savez(run / "samples.npz", **{name: array for name, array in arrays.items() if array is not None})
    if not isinstance(change, dict):
        content = change if isinstance(change, bytes) else change((run / "samples.npz").read_bytes())
        (run / "samples.npz").write_bytes(content)
    record(run, ["samples.npz"])
    with pytest.raises(DataError, match=words) as refused:
        load_samples(run)
    assert "samples.npz" in str(refused.value)


def test_good_samples_with_targets_of_nothing_are_read(tmp_path):
    run = make_run(tmp_path / "run", count=20)
    np.savez(run / "samples.npz", **{**good_arrays(), "log_target": np.where(np.arange(9) < 3, -np.inf, 0.0)})
    record(run, ["samples.npz"])
    assert np.isfinite(load_samples(run).weights).all()


@pytest.mark.parametrize("shape", ["(1000000000000,)", "(4294967296, 4294967296)"])
def test_no_room_is_made_for_what_a_header_only_promises(tmp_path, shape):
    """numpy would ask for 8 TB before it finds that there is nothing."""
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    with zipfile.ZipFile(tmp_path / "rays.npz", "w") as archive:
        archive.writestr("points.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(80))
    for read in (load_design, load_capture):
        with pytest.raises(DataError, match="80 bytes of data"):
            read(tmp_path / "rays.npz")


def test_letters_that_do_not_exist_are_refused_where_names_are_read(tmp_path):
    names = np.array([sys.maxunicode + 1], dtype=np.uint32).view("<U1")
    np.savez(tmp_path / "rays.npz", azimuth_rad=[0.0], elevation_rad=[0.0], gate_end_m=[1.0], sensor_names=names)
    with pytest.raises(DataError, match="'sensor_names' holds letters that do not exist"):
        load_design(tmp_path / "rays.npz")


BAD_PROGRESS = {
    "an infinite step": '{"step": 1e400, "seconds": 1}',
    "a step of many digits": '{"step": 1' + "0" * 400 + ', "seconds": 1}',
    "no time": '{"step": 20, "seconds": NaN}',
    "a step of text": '{"step": "x", "seconds": 1}',
    "a list": "[20, 1]",
    "a step backwards": '{"step": 5, "seconds": 1}',
    "bytes": "\ufffd",
    "nesting": "[" * 100_000,
}


@pytest.mark.parametrize("case", BAD_PROGRESS)
def test_progress_that_is_none_is_refused_and_cut_back_at_resume(tmp_path, case):
    run = make_run(tmp_path / "run", count=20)
    good = '{"step": 10, "seconds": 0.5}'
    (run / "progress.jsonl").write_text(f"{good}\n{BAD_PROGRESS[case]}\n")
    record(run, ["progress.jsonl"])
    with pytest.raises(DataError, match="does not hold the progress of learning"):
        seconds_at(run)
    assert _step_of(good) == 10
    assert _step_of(BAD_PROGRESS[case]) in (20, 5, math.inf)


@pytest.mark.parametrize("header", [b"{" * 300, b"(", b"{'descr': '<f8', 'fortran_order': False, 'shape': (1", b""])
def test_a_cached_field_with_a_damaged_header_is_built_again(tmp_path, header):
    content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    (tmp_path / "field.npy").write_bytes(content + _digest(content))
    assert _load(tmp_path / "field.npy", 8) is None


# --- geometry


@pytest.mark.parametrize("scale", [1e154, 1e300, 2 * FARTHEST_M])
def test_a_mesh_beyond_all_distances_is_refused_without_a_warning(scale):
    with pytest.raises(DataError, match="reaches"):
        check_mesh(CORNERS * scale, FACES)
    assert len(check_mesh(CORNERS * FARTHEST_M, FACES).faces) == 4


def test_a_scale_that_overflows_is_refused_without_a_warning(tmp_path):
    (tmp_path / "m.obj").write_text("v 1e300 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")
    with pytest.raises(DataError, match="infinite"):
        load_mesh(tmp_path / "m.obj", scale=1e10)


def test_directions_whose_length_overflows_are_refused_without_a_warning(tmp_path):
    arrays = {name: value for name, value in make_capture(3).items() if not name.endswith("_deg")}
    np.savez(tmp_path / "s.npz", **{**arrays, "direction": np.full((3, 3, 3), 1e200)})
    with pytest.raises(DataError, match="length inf"):
        load_capture(tmp_path / "s.npz")


def test_what_mujoco_warns_of_becomes_a_note_of_the_robot(tmp_path):
    piece = '<body pos="0 0 .1"><joint axis="0 0 1"/>{}'
    geom = '<geom type="capsule" size=".03" fromto="0 0 0 0 0 .18" density="{}"/>'
    links = [piece.format(geom.format("1e-12" if link == 6 else "1e12")) for link in range(7)]
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{''.join(links)}{'</body>' * 7}</worldbody></mujoco>")
    assert all("\n" not in note for note in load_robot(tmp_path / "arm.xml", 0.15).notes)


@pytest.mark.parametrize("key", ["bin_ps", "bits_per_bin", "rate_hz"])
@pytest.mark.parametrize("value", [5e-324, 1e-300, 1e300])
def test_a_read_out_that_no_detector_has_is_refused_without_a_warning(key, value):
    with pytest.raises(ConfigError, match=key):
        Constraints.from_mapping({"budget": {key: value, "rays": 10, "bandwidth_mbps": 5.0}})


# --- numbers that no computer bears


@pytest.mark.parametrize("rays", [MOST_RAYS + 1, 10**12, 10**30])
def test_more_rays_than_any_computer_bears_are_refused_in_a_design(tmp_path, rays):
    (tmp_path / "d.yaml").write_text(GOOD.replace("rays: 100", f"rays: {rays}"))
    with pytest.raises(ConfigError, match=str(MOST_RAYS)):
        load_design(tmp_path / "d.yaml")
    with pytest.raises(ConfigError, match="rays"):
        split_budget(np.ones(2), rays)


@pytest.mark.parametrize(
    "arguments",
    [
        "fit run --rays 1000000000000",
        "constrain run --set sensors.max=1000000000",
        "constrain run --set budget.rays=1000000000000000000000000",
        "evaluate run --rays 1000000000000",
        "learn flatland --out out --set learning.batch=1000000000000",
        "learn flatland --out out --set learning.hidden=10000000",
        "learn flatland --out out --set learning.samples=1000000000000",
        "learn flatland --out out --set learning.coverage_proposals=1000000000000",
    ],
)
def test_commands_refuse_numbers_that_no_computer_bears(lidardesign, tmp_path, arguments):
    make_run(tmp_path / "run", count=2000)
    result = lidardesign(*arguments.split())
    assert result.code == 2, result.err
    assert "1000" in result.err
    assert not (tmp_path / "out").exists()


def test_more_sensors_than_a_mixture_may_have_are_refused_before_anything_is_computed():
    samples = Samples(np.full((50, 6), 0.5), np.zeros(50), np.zeros(50), SPACE)
    with pytest.raises(ConfigError, match=f"1 to {MOST_FITTED}"):
        fit_sensors(FitProblem(samples=samples, constraints=Constraints(), sensors=10**9))
    with pytest.raises(ConfigError, match="1000"):
        Constraints.from_mapping({"sensors": {"min": MOST_FITTED + 1}})


@pytest.mark.parametrize("reader", ["--set", "key", "name"])
def test_a_message_does_not_repeat_whole_pages_of_its_input(lidardesign, tmp_path, reader):
    page = "long" * 20_000
    (tmp_path / "c.yaml").write_text(f"{page}: 1\n" if reader == "key" else f"gate: {page}\n")
    make_run(tmp_path / "run")
    extra = ["--set", f"gate={page}"] if reader == "--set" else ["--constraints", "c.yaml"]
    result = lidardesign("constrain", "run", *extra)
    assert result.code == 2
    assert 20 < len(result.err) < 5000


def test_memory_that_torch_does_not_get_is_no_fault_of_the_program():
    import torch

    with pytest.raises(RuntimeError) as refused:
        torch.empty(1 << 60, dtype=torch.uint8)
    for lost in (refused.value, MemoryError(), OSError(errno.ENOMEM, "Cannot allocate memory")):
        document, code, text = describe_error(lost, Output())
        assert (document["kind"], code) == ("memory", 5)
        assert "fault" not in text
