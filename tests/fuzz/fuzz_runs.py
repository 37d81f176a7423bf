"""The files of a run as commands read them, behind the hashes that would refuse any damage first."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

from support.command_line import make_run

from fuzz.attempts import Read, of_file
from lidardesign.config import RunConfig, resolve
from lidardesign.registry import load_task

# Two steps of a small flow, measured roughly.
SMALL = (
    "learning.steps=2", "learning.samples=1000", "learning.batch=16", "learning.hidden=8", "learning.layers=1",
    "learning.bins=4", "learning.balance_proposals=256", "learning.coverage_proposals=256",
)  # fmt: skip


def small_config() -> RunConfig:
    """A configuration of flatland that is learned in a moment."""
    return resolve(load_task("flatland"), preset="draft", overrides=SMALL)


def rerecord(run: Path, name: str, content: bytes) -> None:
    """Put a file into a run with its hash, as somebody would who means it; without waiting for the disk."""
    (run / name).write_bytes(content)
    manifest = json.loads((run / "manifest.json").read_bytes())
    manifest["files"][name] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    (run / "manifest.json").write_text(json.dumps(manifest))


def open_manifests(folder: Path) -> Read:
    """As every command does that is given a run."""
    from lidardesign import open_run
    from lidardesign.density.training.checkpoint import stored_snapshots
    from lidardesign.run.manifest import verify

    run = make_run(folder / "run", count=50)

    def read(content: bytes) -> object:
        (run / "manifest.json").write_bytes(content)
        opened = open_run(run)
        verify(run, "samples.npz")
        return opened.config.space, stored_snapshots(run)

    return read


def _behind_hash(name: str, read: Callable[[Path], object]) -> Callable[[Path], Read]:
    """A reader of a file of a run whose hash is right."""

    def opened(folder: Path) -> Read:
        run = make_run(folder / "run", count=50)

        def read_content(content: bytes) -> object:
            rerecord(run, name, content)
            return read(run)

        return read_content

    return opened


def _read_samples(run: Path) -> object:
    """As `fit` does."""
    from lidardesign.samples import load_samples

    samples = load_samples(run)
    return samples.points, samples.weights, samples.effective_sample_size


def _read_progress(run: Path) -> object:
    """As `evaluate --accuracy` does."""
    from lidardesign.density.training.learned import seconds_at

    return seconds_at(run)


open_samples = _behind_hash("samples.npz", _read_samples)
open_progress = _behind_hash("progress.jsonl", _read_progress)


def open_fields(folder: Path) -> Read:
    """As `learn` does with its cache: what cannot be used is built again."""
    from lidardesign.density.fields.grids import _digest, _load

    read = of_file(".npy", lambda path: _load(path, 64))(folder)
    return lambda content: (read(content), read(content + _digest(content)))


def _trainer(run: Path) -> object:
    """A trainer at its first step, with a small flow and nothing to train on."""
    import torch

    from lidardesign.density.coordinates import Coordinates
    from lidardesign.density.training.learn import make_flow
    from lidardesign.density.training.trainer import Trainer

    config = small_config()
    generator = torch.Generator().manual_seed(0)
    flow, coordinates = make_flow(config, generator), Coordinates(config.space)
    trainer = Trainer(flow, None, coordinates, generator, config.learning, run, None)
    for parameter in trainer.flow.parameters():
        parameter.grad = torch.zeros_like(parameter)
    trainer.optimiser.step()
    return trainer


def checkpoints(folder: Path) -> list[bytes]:
    """The checkpoint of a small flow."""
    run = make_run(folder / "checkpointed", count=50)
    trainer = _trainer(run)
    trainer._save(*trainer._state())
    return [(run / "checkpoint.safetensors").read_bytes()]


def open_checkpoints(folder: Path) -> Read:
    """As `learn --resume` does, behind the hash, and a step of the optimiser from there."""
    import torch

    run = make_run(folder / "run", count=50)

    def read(content: bytes) -> object:
        rerecord(run, "checkpoint.safetensors", content)
        trainer = trainers[0]
        trainer.optimiser.state.clear()
        trainer.resume()
        weights = [value.detach().numpy().copy() for value in trainer.flow.state_dict().values()]
        for parameter in trainer.flow.parameters():
            parameter.grad = torch.zeros_like(parameter)
        trainer.optimiser.step()
        return weights, trainer._rate()

    trainers = [_trainer(run)]
    return read
