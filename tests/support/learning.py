"""A small task to learn, and how its learning is interrupted."""

from __future__ import annotations

from types import SimpleNamespace

import torch

import lidardesign.density.training.learn as density_learn
from lidardesign.config import DensitySettings, LearningSettings, RunConfig
from lidardesign.density.training import learn as learning
from lidardesign.density.training import trainer as training
from lidardesign.density.training.learn import prepare_training_data
from lidardesign.run.manifest import FILE_NAME, start_manifest
from lidardesign.scenes.scene import Body, Scene, Sphere, rigid
from lidardesign.space import DesignSpace
from lidardesign.task import Defaults, Metric, TaskConfig
from support.small_runs import shifted

SPACE = DesignSpace((0, 0, 0, -0.4, 0, 0.2), (0, 0, 0, 0.4, 0, 2.5))

SMALL = {
    "misplaced": 0.0, "steps": 120, "pathwise": 50, "batch": 48, "layers": 1, "hidden": 12, "bins": 8, "samples": 2000,
    "balance_proposals": 512, "coverage_proposals": 512, "checkpoint_seconds": 1e-9,
}  # fmt: skip


class BallTask:
    """One ball in front of the sensor."""

    name, summary, api_version = "ball", "one ball", 1
    Config = TaskConfig
    metric = Metric("hits", "-", "higher", 0.0, 0.0)
    defaults = Defaults()

    def space(self, config):
        return SPACE

    def scenes(self, config, split, seed):
        return [Scene((Body(Sphere(0.5), poses=rigid(translation_m=(1.5, 0, 0))),))]

    def score(self, scene, returns):
        raise NotImplementedError


def config_of(space=SPACE, seed=3, **settings):
    return RunConfig(
        task_name="ball", seed=shifted(seed), preset="draft", task=TaskConfig(), space=space,
        density=DensitySettings(sigma_m=0.05), learning=LearningSettings(**{**SMALL, **settings}),
    )  # fmt: skip


def begun(run):
    """A folder, made a run as by the command if it is none."""
    if not (run / FILE_NAME).exists():
        start_manifest(run, command=[], seed=0)
    return run


def learn(task, config, run, **options):
    """Learn in a folder, which is made a run as by the command."""
    return density_learn.learn(task, config, begun(run), **options)


def result_bytes(run):
    return (run / "flow.safetensors").read_bytes(), (run / "samples.npz").read_bytes()


class Interrupter:
    """A progress callback that presses Ctrl-C at a step."""

    def __init__(self, step):
        self.step = step

    def __call__(self, progress):
        if progress.step == self.step:
            raise KeyboardInterrupt


def a_trainer(run):
    config = config_of()
    return learning.make_trainer(prepare_training_data(BallTask(), config), config, begun(run), torch.device("cpu"))


def interrupt_after_a_checkpoint(monkeypatch, folder):
    """Make learning stop as Ctrl-C does, once the folder has a checkpoint and more steps were made."""
    learn_density, seen = density_learn.learn, SimpleNamespace(step=None)

    def interrupted(*arguments, progress, **options):
        def stop(now):
            progress(now)
            if (folder / "checkpoint.safetensors").exists():
                seen.step = now.step if seen.step is None else seen.step
                if now.step > seen.step:
                    raise KeyboardInterrupt

        return learn_density(*arguments, progress=stop, **options)

    monkeypatch.setattr(density_learn, "learn", interrupted)
    monkeypatch.setattr(training, "STRETCH", 7)
    monkeypatch.setattr(training, "PROGRESS_STEPS", 2)
