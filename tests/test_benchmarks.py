"""The scripts of benchmarks/ start and say what they do; their helpers and the example's pictures work."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path for path in (ROOT / "benchmarks").glob("*.py") if path.stem != "common")


@pytest.fixture(scope="module")
def common():
    spec = importlib.util.spec_from_file_location("benchmarks_common", ROOT / "benchmarks" / "common.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_benchmark_imports_and_explains_itself(script):
    if script.stem == "em":
        pytest.importorskip("sklearn")
    done = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("usage:")
    assert f"benchmarks/{script.name}" in done.stdout


def test_every_benchmark_is_documented():
    text = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    for script in SCRIPTS:
        assert f"python benchmarks/{script.name}" in text


def test_a_command_is_measured_from_outside(common):
    words = [sys.executable, "-c", "import sys; x = bytearray(2 ** 25); print('{\"a\": 1}')"]
    result = common.run_process(words)
    assert result.document() == {"a": 1}
    assert result.peak_mib > 32
    assert result.wall > 0


def test_a_command_that_fails_ends_the_benchmark_with_its_message(common):
    result = common.run_process([sys.executable, "-c", "import sys; sys.exit('what went wrong')"])
    with pytest.raises(SystemExit, match="what went wrong"):
        result.document()


def test_contestants_take_turns_after_one_round_that_is_not_counted(common):
    calls = []
    measured = common.interleaved({name: lambda name=name: calls.append(name) for name in "ab"}, rounds=2)
    assert calls == list("ababab")
    assert all(len(timing.wall) == len(timing.cpu) == 2 for timing in measured.values())


def test_ratios_are_taken_round_by_round(common):
    assert common.median_ratio([1.0, 10.0, 100.0], [2.0, 20.0, 50.0]) == 0.5


@pytest.mark.slow
def test_the_flatland_pictures_are_drawn(tmp_path):
    settings = ["learning.steps=3", "learning.samples=1000", "learning.balance_proposals=256", "train=3"]
    words = [word for setting in settings for word in ("--set", setting)]
    script = ROOT / "examples" / "flatland_figures.py"
    done = subprocess.run(
        [sys.executable, script, "--out", tmp_path, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["density.png", "existing_lidars.png", "scene_point.png"]
