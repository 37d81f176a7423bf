"""Learning from moving scenes: frames drawn at random in every step leave the bytes of a run repeatable."""

from __future__ import annotations

import pytest
from support.command_line import set_options
from support.learning import interrupt_after_a_checkpoint

from lidardesign.density.objective import proposals

SETTINGS = (
    "size=small", "train=2", "test=1", "frames=6", "learning.steps=30", "learning.batch=64", "learning.samples=1000",
    "learning.coverage_proposals=256", "learning.balance_proposals=256", "learning.checkpoint_seconds=0.001",
    "learning.frames=3",
)  # fmt: skip
RESULTS = ("flow.safetensors", "samples.npz")


def learn(lidardesign, out, *further):
    words = (*set_options(SETTINGS, further), *further, "--json")
    return lidardesign("learn", "arm", "--preset", "draft", "--out", out, *words)


@pytest.mark.hard_case("P1")
@pytest.mark.slow
def test_an_interrupted_run_over_moving_frames_is_resumed_to_the_bytes_of_a_straight_one(
    lidardesign, tmp_path, monkeypatch
):
    assert learn(lidardesign, "straight").code == 0
    with monkeypatch.context() as patched:
        interrupt_after_a_checkpoint(patched, tmp_path / "stopped")
        assert learn(lidardesign, "stopped").code == 130
    assert not (tmp_path / "stopped" / "samples.npz").exists()
    assert learn(lidardesign, "stopped", "--resume").code == 0
    for name in RESULTS:
        assert (tmp_path / "stopped" / name).read_bytes() == (tmp_path / "straight" / name).read_bytes()
    assert not list(tmp_path.rglob("MUJOCO_LOG*"))


def test_coverage_that_cannot_be_measured_counts_as_none_and_is_said(lidardesign, monkeypatch):
    draw = proposals.independent_points

    def none_is_drawn_at_the_end(target, count, generator):
        points, log_density = draw(target, count, generator)
        kept = 0 if count == 1500 else len(points)
        return points[:kept], log_density[:kept]

    monkeypatch.setattr(proposals, "independent_points", none_is_drawn_at_the_end)
    done = learn(lidardesign, "run", "--set", "learning.steps=3", "--set", "learning.coverage_proposals=1500")
    assert done.code == 0
    assert done.json["coverage"] == 0
    (said,) = [note for note in done.json["notes"] if "coverage could not be measured" in note]
    assert "misplaced leaves out what the density dropped" in said
