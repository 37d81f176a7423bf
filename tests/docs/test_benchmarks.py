"""The scripts of benchmarks/ start and say what they do; their helpers and the example's pictures work."""

from __future__ import annotations

import importlib
import json
import runpy
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from support.docs_session import in_process
from support.meshes import BOX_FACES, BOX_VERTICES
from support.small_runs import shifting_environment

from lidardesign.scenes.scene import Mesh

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(path for path in (ROOT / "benchmarks").glob("*.py") if path.stem != "common")


@pytest.fixture
def script(monkeypatch):
    """A benchmark script as a module, by its name."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    before = set(sys.modules)
    yield importlib.import_module
    for name in {"common", *(path.stem for path in SCRIPTS)} & (set(sys.modules) - before):
        del sys.modules[name]


@pytest.fixture
def common(script):
    return script("common")


@pytest.fixture
def run_here(monkeypatch, capsys, common):
    """Runs a script of benchmarks/ in this process, which has imported what takes long; what it prints."""
    state = torch.get_rng_state()

    def run(name, *words):
        path = ROOT / "benchmarks" / f"{name}.py"
        monkeypatch.setattr(sys, "argv", [str(path), *map(str, words)])
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    from_outside = common.run_process

    def from_inside(command, environment=None):
        """What the program would do in a process of its own, whose start takes longest."""
        if Path(command[0]).name != "lidardesign":
            return from_outside(command, environment)
        began = time.perf_counter()
        with monkeypatch.context() as patched:
            for key, value in (environment or {}).items():
                patched.setenv(key, value)
            ran = in_process(command[1:])
        taken_s = time.perf_counter() - began
        return common.ProcessResult(ran.code, ran.out, ran.err, taken_s, taken_s, 1.0)

    monkeypatch.setattr(common, "run_process", from_inside)
    for key, value in shifting_environment().items():
        monkeypatch.setenv(key, value)
    yield run
    torch.set_rng_state(state)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_benchmark_imports_and_explains_itself(path, run_here, capsys):
    if path.stem == "em":
        pytest.importorskip("sklearn")
    with pytest.raises(SystemExit) as ended:
        run_here(path.stem, "--help")
    assert not ended.value.code
    told = capsys.readouterr().out
    assert told.startswith("usage:")
    assert f"benchmarks/{path.name}" in " ".join(told.split())


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


def test_the_reference_of_ray_casting_meets_a_box_where_planes_do(script):
    box = Mesh(2 * BOX_VERTICES - 1, BOX_FACES)
    generator = np.random.default_rng(0)
    origins = np.column_stack([np.full(200, 3.0), generator.uniform(-2, 2, (200, 2))])
    targets = np.column_stack([np.full(200, 1.0), generator.uniform(-2, 2, (200, 2))])
    directions = (targets - origins) / np.linalg.norm(targets - origins, axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        low, high = ((side - origins) / directions for side in (-1.0, 1.0))
    enters, leaves = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    expected = np.where((enters <= leaves) & (enters > 0), enters, np.inf)
    found = script("raycasting").reference(box, origins, directions)
    assert 50 < np.isfinite(expected).sum() < 150
    assert found == pytest.approx(expected, abs=1e-12)


def test_the_log_density_of_every_flow_that_is_compared_is_that_of_its_jacobian(script):
    flow = script("flow")
    sizes = flow.Sizes(batch=8, layers=2, bins=4, hidden=8, dtype=torch.float64)
    base = 1.9 * torch.rand(8, flow.FEATURES, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.95
    for name, contestant in flow.contestants(sizes, compiled=False).items():
        assert flow.jacobian_error(contestant, base) < 1e-9, name


def baseline_document(difference=-0.5, low=-0.9, high=-0.1):
    """What `evaluate` prints about `fit` against one baseline, at one number of rays."""
    row = {"rays": 10, "ci_low": 0.0, "ci_high": 9.0, "bandwidth_mbps": 2.0}
    pair = {"a": "fit", "b": "bounding", "rays": 10, "difference": difference, "ci_low": low, "ci_high": high}
    pair["percent"] = [100 * end / 5.0 for end in (difference, low, high)]
    return {
        "metric": {"name": "error", "unit": "mm", "better": "lower"},
        "scenes": 3,
        "rows": [{**row, "design": "fit", "value": 4.5}, {**row, "design": "bounding", "value": 5.0}],
        "paired": [pair],
        "equal_bandwidth": [{**row, "design": "bounding", "value": 5.0, "matched_to": "fit", "matched_rays": 10}],
        "paired_equal_bandwidth": [pair],
    }


def test_a_baseline_is_beaten_where_the_interval_says_so(script):
    baselines = script("baselines")
    cases = {"better": (-0.5, -0.9, -0.1), "worse": (0.5, 0.1, 0.9), "no significant difference": (-0.1, -0.5, 0.4)}
    for word, numbers in cases.items():
        found = baseline_document(*numbers)
        (row,) = [row for row in baselines.equal_rays(found) if row[1] == "bounding"]
        assert word in row[-1]
        assert row[-1].startswith(f"{100 * numbers[0] / 5:+.1f} (")
        (matched,) = baselines.equal_bandwidth(found)
        assert word in matched[-1]
        assert all(line.startswith("holds") == (word == "better") for line in baselines.verdicts(found)[::2])


def test_a_page_takes_what_was_measured_between_its_marks_and_keeps_the_rest(script, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n\n<!-- face -->\n\nold\n\n<!-- face -->\n\nafter\n")
    found = {**baseline_document(), "where": "Measured here."}
    script("baselines").write_page(page, {"face": found})
    once = page.read_text()
    assert once.startswith("before\n\n<!-- face -->\n\nError in mm on 3 held-out scenes. Measured here.")
    assert once.endswith("<!-- face -->\n\nafter\n")
    assert "| `bounding` | -10.0 (-18.0 to -2.0) |" in " ".join(once.split())
    assert "`fit`, equal rays: better than 1 of 1," in once
    assert "old" not in once
    script("baselines").write_page(page, {"face": found})
    assert page.read_text() == once
    with pytest.raises(SystemExit, match=r"arm.* 0 times"):
        script("baselines").write_page(page, {"arm": found})


def test_a_journey_is_compared_command_by_command_and_what_is_kept_is_not_measured_again(script, monkeypatch, tmp_path):
    journey, ran = script("journey"), []

    def measured(root, words, here, caches):
        here.mkdir(parents=True, exist_ok=True)
        ran.append(words[0])
        half = 0.5 if root == ROOT else 1.0
        took = {"wall_s": 9.0, "cpu_s": 8 * half, "mib": 100.0, "cold_s": None, "misplaced": 0.1}
        digest = None if words[0] == "learn" else words[0]
        return took | {"score": 5.0 if half < 1 else 4.0, "better": -1, "digest": digest}

    monkeypatch.setattr(journey, "measured", measured)
    words = ["--folder", tmp_path, "--before", tmp_path, "--only", "aisle", "--seeds", "2", "--json", tmp_path / "out"]
    monkeypatch.setattr(sys, "argv", ["journey", *map(str, words)])
    for _ in range(2):
        journey.main()
        found = json.loads((tmp_path / "out").read_text())
        times, quality = found["tables"].values()
        assert {row["CPU / before"] for row in times} == {0.5}
        assert times[-1] | {"command": "all", "CPU s": 24.0, "before: CPU s": 48.0} == times[-1]
        assert quality[0]["worse by"] == 0.8
        assert all(line.startswith("holds") for line in found["conclusions"])
    assert len(ran) == 2 * 2 * 6
    assert ran[:4] == ["learn", "learn", "fit", "fit"]


def settings(*pairs):
    """Words that make `learn` small; a blurred density is learned well enough on any processor: see `small_runs`."""
    learning = ("steps=80", "samples=4000", "balance_proposals=2048", "coverage_proposals=512")
    return [word for pair in (*(f"learning.{one}" for one in learning), *pairs) for word in ("--set", pair)]


SMALL_ARM = settings("size=small", "train=2", "test=2", "density.sigma_m=0.2")
SMALL_WAREHOUSE = settings("size=small", "train=3", "test=2", "positions=1", "density.sigma_m=0.25")


FACE = ("--model", "embedded")
ROUGH = settings("train=3", "density.sigma_m=0.04")
# Every benchmark at its smallest that runs for a minute at most, and how many tables it prints.
SMALLEST = [
    ("arm", ["--preset", "draft", *SMALL_ARM, "--sensors", "2", "--rays", "40"]),
    ("commands", ROUGH),
    ("constrain", [*FACE, *ROUGH, "--only", "none", "--only", "10 sensors"]),
    ("effects", [*FACE, "--heads", "2", "--rays", "16", "--many", "100"]),
    ("fields", [*FACE, "--scenes", "2", "--resolution", "24", "--trimesh-points", "50"]),
    ("flow", ["--batch", "64", "--layers", "2", "--bins", "4", "--hidden", "8"]),
    ("frames", ["--robot", "embedded", "--trajectories", "2", "--frames", "12", "--points", "64", "--casters", "6"]),
    ("growth", [*FACE, "--of", "rays", "--rays", "100", "200", "--samples", "2000", "--heads", "2", "--batch", "64"]),
    ("learn", [*FACE, "--preset", "draft", *ROUGH, "--goals", "0.95", "--kl", "1000"]),
    ("occlusion", [*SMALL_ARM, "--preset", "draft", "--rays", "40", "80", "--further-rays", "120"]),
    ("raycasting", [*FACE, "--rays", "2000", "--checked", "100"]),
    ("baselines", ["--folder", "kept", "--task", "warehouse", "--preset", "draft", *SMALL_WAREHOUSE, "--rays", "6"]),
    ("selection", [*FACE, "--scenes", "4", "8", "--candidates", "100", "200", "--count", "25", "--problems", "2"]),
    ("target", [*FACE, "--scenes", "2", "--batch", "128", "--points", "8", "--resolution", "24"]),
    ("visibility", [*FACE, "--scenes", "2", "--batch", "64", "--points", "8", "16"]),
    ("warehouse", ["--preset", "draft", *SMALL_WAREHOUSE, "--rays", "4", "--fit-rays", "4", "--at", "0", "0.37"]),
]


@pytest.mark.long
@pytest.mark.parametrize(("name", "words"), SMALLEST, ids=[name for name, _ in SMALLEST])
def test_a_benchmark_runs_at_its_smallest(run_here, tmp_path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    assert "| ---" in run_here(name, "--rounds", "1", "--json", "found.json", *words)
    assert all(json.loads((tmp_path / "found.json").read_text(encoding="utf-8"))["tables"].values())


@pytest.mark.long
def test_the_flatland_pictures_are_drawn(tmp_path):
    settings = ["learning.steps=3", "learning.samples=1000", "learning.balance_proposals=256", "train=3"]
    words = [word for setting in settings for word in ("--set", setting)]
    script = ROOT / "examples" / "flatland_figures.py"
    done = subprocess.run(
        [sys.executable, script, "--out", tmp_path, *words], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["density.png", "existing_lidars.png", "scene_point.png"]
