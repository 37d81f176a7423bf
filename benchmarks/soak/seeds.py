"""Learning from many seeds, `make soak-seeds`: every one learns well enough.

A program of one thread each. What is enough: face, draft: ESS above 0.3 and KL below 0.5 nats; face, standard: 0.5 and
0.15; arm, draft: 0.2 and 2; arm, standard: 0.35 and 0.8.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from benchmarks.soak.long_runs import amount

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
    made = {"case": f"{task}, {preset}"}
    if done.returncode:
        return {**made, "faults": [f"exit {done.returncode}: {(done.stdout + done.stderr).decode()[-500:]}"]}
    figures = {name: json.loads(done.stdout)[name] for name in SHOWN}
    least_ess, most_nats = LIMITS[task, preset]
    faults = [f"ESS {figures['ess']:.3f}"] if figures["ess"] <= least_ess else []
    faults += [f"KL {figures['kl_nats']:.3g} nats"] if figures["kl_nats"] >= most_nats else []
    return {**made, "figures": figures, "faults": faults}
