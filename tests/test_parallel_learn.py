"""`learn` as several processes: one result, one writer, and an end for all when one of them dies."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import pytest
from ranks import SMALL_WAIT_S, finished, start_ranks

from lidardesign.cli.main import run as run_program

TINY = (
    "train=4", "learning.steps=200", "learning.batch=64", "learning.layers=1", "learning.hidden=16",
    "learning.samples=2000", "learning.balance_proposals=512", "learning.coverage_proposals=256",
    "learning.checkpoint_seconds=0.001", "learning.dtype=float64",
)  # fmt: skip
LOST = 3
pytestmark = pytest.mark.slow


def learning(folder, *further):
    settings = [part for text in TINY for part in ("--set", text)]
    return ["learn", "flatland", "--preset", "draft", "--out", str(folder), "--seed", "3", *settings, *further]


def learned(folder):
    return (folder / "flow.safetensors").read_bytes(), (folder / "samples.npz").read_bytes()


@pytest.fixture(scope="module")
def by_torchrun(tmp_path_factory):
    """What two ranks of torchrun learn: the folder and their whole stdout."""
    folder = tmp_path_factory.mktemp("torchrun") / "run"
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    ended = subprocess.run(
        [*launcher, "-m", "lidardesign", *learning(folder, "--json")],
        capture_output=True, text=True, timeout=SMALL_WAIT_S, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return folder, ended.stdout


def test_two_ranks_of_torchrun_print_one_document_and_write_one_run(by_torchrun):
    folder, out = by_torchrun
    found = json.loads(out)
    assert found["steps"] == 200
    assert found["run"] == str(folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["ranks"] == 2
    rows = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == list(range(10, 201, 10))


def test_two_ranks_reach_what_one_process_reaches(by_torchrun, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run_program(learning(tmp_path / "run", "--json"))
    alone, together = json.loads(capsys.readouterr().out), json.loads(by_torchrun[1])
    for name in ("ess", "kl_nats", "log_z", "coverage"):
        error = alone["error_estimates"][name]["error"]
        assert abs(alone[name] - together[name]) <= 4 * error, name


def wait_for_checkpoint(folder, after=0.0):
    """The time of a run's next checkpoint."""
    deadline = time.monotonic() + SMALL_WAIT_S
    path = folder / "checkpoint.safetensors"
    while not (path.exists() and path.stat().st_mtime > after):
        assert time.monotonic() < deadline, "no checkpoint came"
        time.sleep(0.01)
    return path.stat().st_mtime


def test_a_killed_rank_ends_all_and_the_last_checkpoint_resumes_to_the_same_bytes(by_torchrun, tmp_path):
    folder = tmp_path / "run"
    ranks = start_ranks(2, "-m", "lidardesign", *learning(folder))
    wait_for_checkpoint(folder)
    ranks[1].send_signal(signal.SIGKILL)
    (code, _, said), (killed, _, _) = finished(ranks)
    assert (code, killed) == (LOST, -signal.SIGKILL)
    assert "another rank ended" in said
    assert "--resume" in said
    assert not (folder / "flow.safetensors").exists()
    saved = wait_for_checkpoint(folder)
    ranks = start_ranks(2, "-m", "lidardesign", *learning(folder, "--resume"))
    wait_for_checkpoint(folder, after=saved)
    ranks[0].send_signal(signal.SIGKILL)
    (killed, _, _), (code, _, said) = finished(ranks)
    assert (killed, code) == (-signal.SIGKILL, LOST)
    assert "rank 1: system error: torchrun: another rank ended" in said
    ended = finished(start_ranks(2, "-m", "lidardesign", *learning(folder, "--resume")))
    assert [status for status, _, _ in ended] == [0, 0]
    assert learned(folder) == learned(by_torchrun[0])


FAILING = """
import os, sys
from lidardesign.density import ground
from lidardesign.errors import DataError

def broken(task, config):
    raise DataError("this computer has no scans", where="scans")

if os.environ["RANK"] == "1":
    ground.training_scenes = broken
from lidardesign.cli.main import run
run(sys.argv[1:])
"""


def test_what_only_one_rank_knows_is_told_by_it(tmp_path):
    folder = tmp_path / "run"
    (code, out, said), (other, silent, told) = finished(
        start_ranks(2, "-c", FAILING, *learning(folder, "--json"))
    )
    assert (code, other) == (LOST, LOST)
    assert json.loads(out)["error"]["kind"] == "system"
    assert "another rank ended" in said
    assert silent == ""
    assert "rank 1: data error: scans: this computer has no scans" in told
    assert not folder.exists()
