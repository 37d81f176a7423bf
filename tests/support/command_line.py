"""Running the program in tests: results, runs as `learn` leaves them, and a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidardesign.cli.main import run as run_program
from lidardesign.config import resolve, save_run_config
from lidardesign.run.manifest import start_manifest
from lidardesign.samples import Samples, save_samples
from lidardesign.task import load_task
from support.spaces import log_volume


class Result:
    """What a command did."""

    def __init__(self, code, captured):
        self.code, self.out, self.err = code, captured.out, captured.err

    @property
    def json(self):
        return json.loads(self.out)


def caller(capsys, tmp_path, monkeypatch):
    """A function that runs the program in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            run_program([str(argument) for argument in arguments])
        return Result(ended.value.code or 0, capsys.readouterr())

    return call


def set_options(settings, further=()):
    """`--set` of each of some settings, without those that further words set otherwise."""
    keys = {str(word).partition("=")[0] for word in further}
    return [word for setting in settings if setting.partition("=")[0] not in keys for word in ("--set", setting)]


# Scenes of a run that is made: what a command does with one it does with all.
FEW_SCENES = {"train": 8, "test": 6}


def make_run(folder: Path, count: int = 4000, task: str = "flatland", seed: int = 3, overrides=()) -> Path:
    """A run as `learn` leaves it, with samples around two spots of its space instead of a learned density."""
    task = load_task(task)
    asked = {setting.partition("=")[0].removeprefix("task.") for setting in overrides}
    few = [f"task.{key}={number}" for key, number in FEW_SCENES.items() if key not in asked]
    config = resolve(task, preset="draft", seed=seed, overrides=[*few, *overrides])
    generator = np.random.default_rng(0)
    points = config.space.sample(count, generator)
    low, high = np.array(config.space.low), np.array(config.space.high)
    scaled = (points - low) / np.where(high > low, high - low, 1.0)
    spots = np.array([[0.3, 0, 0, 0.4, 0, 0.6], [0.7, 0, 0, 0.6, 0, 0.5]])
    distance = ((scaled[:, None] - spots) ** 2).sum(-1)
    log_target = np.logaddexp(*(-distance.T / (2 * 0.1**2)))
    start_manifest(folder, command=["lidardesign", "learn"], seed=seed)
    save_run_config(config, folder)
    log_prob = np.full(count, -log_volume(config.space))
    save_samples(Samples(points, log_prob, log_target, config.space), folder)
    return folder


def files_under(folder: Path) -> dict[str, bytes]:
    """The content of every file in a folder but compiled modules, by its path."""
    paths = [path for path in folder.rglob("*") if path.is_file() and path.parent.name != "__pycache__"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


# A suite that runs in the background of a shell hands on that interruptions are ignored.
LISTENING = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"


def program(*arguments, before="", **options) -> subprocess.Popen:
    """The program in a process of its own; `before` is Python that runs first."""
    code = f"{LISTENING}\n{before}\nfrom lidardesign.__main__ import run\nrun()"
    words = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **options)
