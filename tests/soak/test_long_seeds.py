"""Learning a task at a preset from many seeds, `make soak-seeds`: a program each, every one learns well enough."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from support.long_runs import amount, paragraph, table

NAME, TITLE = "seeds", "Learning from many seeds"
# The least ESS and the largest KL [nats] that every seed has to reach, by task and preset.
LIMITS = {
    ("face", "draft"): (0.3, 0.5),
    ("face", "standard"): (0.5, 0.15),
    ("arm", "draft"): (0.2, 2.0),
    ("arm", "standard"): (0.35, 0.8),
}
SHOWN = ("ess", "kl_nats", "log_z", "coverage", "misplaced", "seconds")
LONGEST_S = 1800.0
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


def pytest_generate_tests(metafunc):
    seeds = range(amount(metafunc.config))
    metafunc.parametrize(("task", "preset", "seed"), [(*key, seed) for key in LIMITS for seed in seeds])


@pytest.mark.long
def test_a_seed_learns_well_enough(tmp_path, piece, task, preset, seed):
    piece(lambda: learned(task, preset, seed, tmp_path / "run"))


def learned(task: str, preset: str, seed: int, run) -> dict:
    """Figures of one seed, or why there are none."""
    command = [sys.executable, "-m", "lidardesign", "learn", task, "--preset", preset, "--seed", str(seed)]
    done = subprocess.run(
        [*command, "--out", str(run), "--json", "--quiet"],
        capture_output=True, env={**os.environ, **ONE_THREAD}, timeout=LONGEST_S, check=False,
    )  # fmt: skip
    made = {"preset": f"{task}, {preset}", "figures": None}
    if done.returncode:
        return {**made, "faults": [f"exit {done.returncode}: {(done.stdout + done.stderr).decode()[-500:]}"]}
    figures = {name: json.loads(done.stdout)[name] for name in SHOWN}
    least_ess, most_nats = LIMITS[task, preset]
    faults = [f"ESS {figures['ess']:.3f}"] if figures["ess"] <= least_ess else []
    faults += [f"KL {figures['kl_nats']:.3g} nats"] if figures["kl_nats"] >= most_nats else []
    return {**made, "figures": figures, "faults": faults}


def parts(pieces: list[dict]) -> list[str]:
    """What the page says: the spread of every figure by task."""
    said = []
    for (task, preset), (least_ess, most_nats) in LIMITS.items():
        name = f"{task}, {preset}"
        own = [one for one in pieces if one["preset"] == name]
        good = [one["figures"] for one in own if one["figures"]]
        enough = sum(not one["faults"] for one in own)
        rows = []
        for figure in SHOWN if good else ():
            values = np.array([one[figure] for one in good], dtype=np.float64)
            deviation = values.std(ddof=1) if len(values) > 1 else 0.0
            rows.append((figure, *(f"{v:.3g}" for v in (values.min(), np.median(values), values.max(), deviation))))
        told = f"{enough} of {len(own)} end with an ESS above {least_ess:g} and a KL below {most_nats:g} nats."
        said += [
            f"## {name}",
            paragraph(f"`learn {task} --preset {preset}` from {len(own)} seeds, one thread each: {told}"),
            table(("figure", "least", "median", "most", "standard deviation"), rows),
        ]
    return said
