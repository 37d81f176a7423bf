"""`learn`: from a task's training scenes to a run folder with the flow, its quality and its weighted samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from lidardesign.config import LearningSettings, RunConfig
from lidardesign.density.flow.flow import DesignFlow
from lidardesign.density.flow.objective import Coordinates
from lidardesign.density.target.device import on_device, stays_on
from lidardesign.density.training.checkpoint import clear_snapshots, save_arrays
from lidardesign.density.training.quality import Measured, draw_probes, measure
from lidardesign.density.training.training import PROGRESS, LearnProgress, Trainer
from lidardesign.density.training.training_data import Ground, prepare_ground
from lidardesign.errors import ConfigError
from lidardesign.estimates import Estimate
from lidardesign.run.clock import phase, running
from lidardesign.run.manifest import note, record
from lidardesign.samples import Samples, save_samples
from lidardesign.scene import Scene
from lidardesign.space import AZIMUTH
from lidardesign.task import Task, random_generator

FLOW = "flow.safetensors"
ON_PROCESSOR = (
    "the target is evaluated on the processor, a round trip a step: on the GPU stay only meshes at rest, with "
    "density.visibility=quadrature or off"
)
DEVICES = ("auto", "cpu", "cuda")


@dataclass(frozen=True)
class LearnResult:
    """What learning reached; `timings` are seconds by phase, `notes` what the user should know.

    `misplaced` is the share of the density's mass in the wrong place. `error_estimates` has the standard errors of ess,
    kl_nats, log_z, coverage and misplaced. `goal` is what decided the number of steps, where the configuration did not.
    """

    run: str
    task: str
    seconds: float
    steps: int
    ess: float
    kl_nats: float
    log_z: float
    coverage: float
    misplaced: float
    notes: tuple[str, ...] = ()
    timings: dict[str, float] = field(default_factory=dict)
    error_estimates: dict[str, Estimate] = field(default_factory=dict)
    goal: dict[str, Any] | None = None

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON form."""
        return {**asdict(self), "notes": list(self.notes)}


def learn(
    task: Task,
    config: RunConfig,
    run: Path,
    *,
    resume: bool = False,
    device: str = "auto",
    progress: Callable[[LearnProgress], None] | None = None,
    ground: Ground | None = None,
    replan: Callable[[Trainer], LearningSettings] | None = None,
) -> LearnResult:
    """Learn the density of a task into a run folder.

    Arguments:
        task: The plugin.
        config: The resolved configuration.
        run: The run folder; its config.yaml is written by the caller.
        resume: Continue from the run's checkpoint; the result is that of an uninterrupted run, bit for bit.
        device: auto, cpu or cuda: where the flow lives, and what of the target can (`device_target`).
        progress: Called about every tenth step.
        ground: What `prepare_ground` made of the same task and configuration, to be learned on again.
        replan: Asked for the settings anew when balancing begins; see `Trainer`.

    Raises:
        ConfigError, DataError: Unusable settings or scenes.
        DivergenceError: Learning stayed non-finite; the last good checkpoint is kept.
    """
    place = choose_device(device)
    with running() as clock:
        ground = prepare_ground(task, config) if ground is None else ground
        trainer = make_trainer(ground, config, run, place)
        trainer.replan = replan
        if resume:
            trainer.resume()
        else:
            (run / PROGRESS).unlink(missing_ok=True)
            clear_snapshots(run)
        with phase("learning"):
            trainer.train(progress)
        # float32 steps train as well and cost less; samples and their densities are worth float64
        trainer.flow.double()
        measured = _measured(trainer, ground.scenes, config)
        _store(trainer, measured.samples, config, run)
    result = LearnResult(
        run=str(run),
        task=config.task_name,
        seconds=round(clock.seconds, 3),
        steps=trainer.step,
        notes=(*ground.notes, *_notes(trainer, place), *measured.notes),
        timings=clock.timings(),
        error_estimates=measured.estimates,
        **{name: estimate.value for name, estimate in measured.estimates.items()},
    )
    found = {"visibility": ground.target.visibility.name, "round_trip_nats": measured.round_trip_nats}
    note(run, learn=result.as_dict(), ranks=1, **found)
    return result


def _notes(trainer: Trainer, place: torch.device) -> list[str]:
    """What the user should know about the training."""
    notes = [] if stays_on(trainer.target, place) else [ON_PROCESSOR]
    if trainer.skipped:
        notes.append(f"{trainer.skipped} steps were not finite and skipped")
    if trainer.doubled_at is not None:
        notes.append(f"float32 could not invert the flow's splines: from step {trainer.doubled_at} on float64")
    return notes


def choose_device(name: str) -> torch.device:
    """The device of a name; auto takes CUDA when it is there.

    Raises:
        ConfigError: The name is none of auto, cpu and cuda, or CUDA was asked for and is not there.
    """
    if name not in DEVICES:
        raise ConfigError(f"unknown device {name!r}", where="--device", allowed=", ".join(DEVICES))
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("no CUDA device is available", where="--device", allowed="auto, cpu")
    return torch.device(name)


@phase("flow")
def make_trainer(ground: Ground, config: RunConfig, run: Path, device: torch.device) -> Trainer:
    """A trainer at its first step."""
    generator = torch.Generator().manual_seed(config.seed)
    flow = make_flow(config, generator).to(device=device, dtype=getattr(torch, config.learning.dtype))
    coordinates = Coordinates(config.space)
    target = ground.target if device.type == "cpu" else on_device(ground.target, device)
    return Trainer(flow, target, coordinates, config.learning, run, generator, ground.pool.to(device))


def make_flow(config: RunConfig, generator: torch.Generator) -> DesignFlow:
    """The flow of a configuration with its initial weights."""
    coordinates, settings = Coordinates(config.space), config.learning
    circular = [config.space.free[n] == AZIMUTH and config.space.full_azimuth for n in coordinates.learned]
    return DesignFlow(
        coordinates.blocks,
        len(coordinates.conditions),
        layers=settings.layers,
        hidden=settings.hidden,
        bins=settings.bins,
        periodic=circular,
        generator=generator,
    )


def _measured(trainer: Trainer, scenes: Sequence[Scene], config: RunConfig) -> Measured:
    generator = random_generator(config.seed, "coverage")
    with phase("measuring"):
        probes = draw_probes(trainer.target, scenes, config.learning.coverage_proposals, generator)
    return measure(trainer, probes, config.learning.samples)


@phase("writing")
def _store(trainer: Trainer, samples: Samples, config: RunConfig, run: Path) -> None:
    weights = {name: value.detach().cpu().numpy() for name, value in trainer.flow.state_dict().items()}
    save_arrays(run, FLOW, weights, {"features": trainer.flow.features, "context": trainer.flow.context})
    save_samples(samples, run)
    if (run / PROGRESS).exists():
        record(run, [PROGRESS])
