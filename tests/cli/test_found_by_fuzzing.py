"""What damaged files and odd libraries once did to the program: each ends in words now."""

from __future__ import annotations

import errno
import math
import struct

import numpy as np
import pytest
from lidardesign_tasks.robot.arm_robot import load_robot
from support.command_line import make_run

from lidardesign.cli.terminal.output import Output, describe_error
from lidardesign.constraints.document import Constraints
from lidardesign.density.fields.grids import _digest, _load
from lidardesign.density.training.learned import seconds_at
from lidardesign.density.training.trainer import _step_of
from lidardesign.errors import ConfigError, DataError, PluginError
from lidardesign.limits import MOST_FITTED, MOST_RAYS
from lidardesign.mixture.fit import FitProblem, fit_sensors
from lidardesign.plugins import plugin_guard
from lidardesign.run.manifest import record
from lidardesign.samples import Samples, load_samples
from lidardesign.scenes.mesh_files import check_mesh
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.simulate.light_transport import transport as light_transport_process
from lidardesign.space import FARTHEST_M, DesignSpace

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_good_samples_with_targets_of_nothing_are_read(tmp_path):
    run = make_run(tmp_path / "run", count=20)
    with np.load(run / "samples.npz") as kept:
        arrays = dict(kept)
    np.savez(run / "samples.npz", **{**arrays, "log_target": np.where(np.arange(20) < 3, -np.inf, 0.0)})
    record(run, ["samples.npz"])
    assert np.isfinite(load_samples(run).weights).all()


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
def test_progress_that_is_none_is_refused_and_cut_back_at_resume(made, case):
    good = '{"step": 10, "seconds": 0.5}'
    (made / "progress.jsonl").write_text(f"{good}\n{BAD_PROGRESS[case]}\n")
    record(made, ["progress.jsonl"])
    with pytest.raises(DataError, match="does not hold the progress of learning"):
        seconds_at(made)
    assert _step_of(good) == 10
    assert _step_of(BAD_PROGRESS[case]) in (20, 5, math.inf)


@pytest.mark.parametrize("header", [b"{" * 300, b"(", b"{'descr': '<f8', 'fortran_order': False, 'shape': (1", b""])
def test_a_cached_field_with_a_damaged_header_is_built_again(tmp_path, header):
    content = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    (tmp_path / "field.npy").write_bytes(content + _digest(content))
    assert _load(tmp_path / "field.npy", 8) is None


def test_the_largest_mesh_is_read():
    assert len(check_mesh(CORNERS * FARTHEST_M, FACES).faces) == 4
    with pytest.raises(DataError, match="reaches"):
        check_mesh(CORNERS * 1e300, FACES)


def test_what_mujoco_warns_of_becomes_a_note_of_the_robot(tmp_path):
    piece = '<body pos="0 0 .1"><joint axis="0 0 1"/>{}'
    geom = '<geom type="capsule" size=".03" fromto="0 0 0 0 0 .18" density="{}"/>'
    links = [piece.format(geom.format("1e-12" if link == 6 else "1e12")) for link in range(7)]
    (tmp_path / "arm.xml").write_text(f"<mujoco><worldbody>{''.join(links)}{'</body>' * 7}</worldbody></mujoco>")
    assert all("\n" not in note for note in load_robot(tmp_path / "arm.xml", 0.15).notes)


def test_numbers_that_no_computer_bears_are_refused_before_anything_is_computed():
    space = DesignSpace((0.0, 0, 0, 2, 0, 0), (1.0, 0, 0, 4, 0, 1))
    samples = Samples(np.full((50, 6), 0.5), np.zeros(50), np.zeros(50), space)
    with pytest.raises(ConfigError, match=f"1 to {MOST_FITTED}"):
        fit_sensors(FitProblem(samples=samples, constraints=Constraints(), sensors=10**9))
    for rays in (MOST_RAYS + 1, 10**30):
        with pytest.raises(ConfigError, match="rays"):
            split_budget(np.ones(2), rays)


def test_memory_that_torch_does_not_get_is_no_fault_of_the_program():
    import torch

    with pytest.raises(RuntimeError) as refused:
        torch.empty(1 << 60, dtype=torch.uint8)
    for lost in (refused.value, MemoryError(), OSError(errno.ENOMEM, "Cannot allocate memory")):
        document, code, text = describe_error(lost, Output())
        assert (document["kind"], code) == ("memory", 5)
        assert "fault" not in text


def interrupted_kernel():
    """What a compiled kernel raises that was interrupted."""
    raise SystemError("returned a result with an exception set") from KeyboardInterrupt()


def test_an_interruption_inside_a_compiled_kernel_is_an_interruption():
    with pytest.raises(SystemError) as raised:
        interrupted_kernel()
    with pytest.raises(PluginError) as blamed, plugin_guard("flatland"):
        interrupted_kernel()
    for error in (raised.value, blamed.value):
        document, code, text = describe_error(error, Output())
        assert (document["kind"], code, text) == ("interrupted", 130, "interrupted")


def test_a_library_that_cannot_be_is_named_where_it_comes_from(monkeypatch, tmp_path):
    monkeypatch.setattr(light_transport_process, "PACKAGES", {})
    for wrong in (tmp_path, tmp_path / "absent.so"):
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(wrong))
        assert light_transport_process.missing().endswith(f"newer: {wrong}")
