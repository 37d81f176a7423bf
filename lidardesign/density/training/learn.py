"""`learn`: from a task's training scenes to a run folder with the flow, its quality and its weighted samples."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidardesign.config import PRESET_LEARNING, RunConfig
from lidardesign.density.coordinates import Coordinates, DeviceTarget, on_device
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.prepare import prepare_target, training_scenes
from lidardesign.density.objective.proposals import independent_samples, log_proposal
from lidardesign.density.objective.scale import scale_notes
from lidardesign.density.objective.target import Target
from lidardesign.density.objective.visibility import common_receiver
from lidardesign.density.training.checkpoint import clear_snapshots, save_flow
from lidardesign.density.training.losses import Pool
from lidardesign.density.training.quality import MeasuredFlow, measure
from lidardesign.density.training.sampling import (
    KnownPoints,
    LearnedFlow,
    MixedSamples,
    condition_groups,
    draw_samples,
    log_density_of,
    mixed,
)
from lidardesign.density.training.trainer import (
    FEWEST_PROBES,
    PROGRESS,
    STOPPING_POINTS,
    LearnProgress,
    Trainer,
    least_balancing_steps,
    reaches,
)
from lidardesign.errors import BackgroundNote, ConfigError, DataError
from lidardesign.estimates import Estimate
from lidardesign.plugins import plugin_guard
from lidardesign.run.clock import peak_memory_bytes, phase, running
from lidardesign.run.manifest import note, record
from lidardesign.samples import Samples, Verdict, save_samples
from lidardesign.scenes.rays import in_view
from lidardesign.scenes.scene import Scene
from lidardesign.space import AZIMUTH, observed_point
from lidardesign.task import Task, notes_of, random_generator

FLOW = "flow.safetensors"
ON_PROCESSOR = (
    "the target is evaluated on the CPU, with a round trip at every step: only meshes at rest with "
    "density.visibility=quadrature or off stay on the GPU"
)
DEVICES = ("auto", "cpu", "cuda")
PILOTS = 2048  # of a flow's samples and of independent points, by which the share of these is chosen


@dataclass(frozen=True)
class LearnResult:
    """The result of learning; `timings` are seconds by phase, `notes` lines for the user.

    `misplaced` is the share of the density's mass in the wrong place. `error_estimates` has the standard errors of ess,
    kl_nats, log_z, coverage and misplaced. `samples` has the numbers of samples of the flow and of
    independent ones, and the effective numbers of all and of those of the flow alone.
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
    samples: dict[str, float] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        """The verdict on the density."""
        return Verdict.of(self.misplaced, self.kl_nats, self.ess)

    def as_dict(self) -> dict[str, Any]:
        """The contract's JSON form."""
        return {**asdict(self), "notes": list(self.notes)}


@dataclass(frozen=True, eq=False)
class TrainingData:
    """The data of learning for any number of steps: the target of the training scenes, notes, and proposals.

    `pool` has the `independent` points with their weights, for balancing. `probes` are points for measuring while
    learning.
    """

    target: Target
    notes: tuple[str, ...]
    pool: Pool
    independent: Samples
    probes: Samples | None = None


def prepare_training_data(task: Task, config: RunConfig, remark: Callable[[str], None] | None = None) -> TrainingData:
    """The training data of a task; it does not depend on the steps, the flow or its optimiser.

    Arguments:
        task: The plugin.
        config: The resolved configuration.
        remark: Called with notes of scenes and on lengths as soon as there are scenes; they are in the notes too.

    Raises:
        ConfigError, DataError: Unusable settings or scenes.
        PluginError: The task's own code failed.
    """
    if not set(config.space.free) - set(config.space.conditioned):
        raise ConfigError(
            "every dimension of the design space is fixed, so there is nothing to learn",
            where="space",
            hint="free at least one, or write the point as a design file",
        )
    with plugin_guard(config.task_name):
        task_notes = notes_of(task, config.task, config.space)
    scenes = training_scenes(task, config)
    of_lengths = scale_notes(scenes, config)
    for line in dict.fromkeys((*of_lengths, *(line for scene in scenes for line in scene.notes))) if remark else ():
        remark(line)
    target, notes = prepare_target(scenes, config)
    with phase("proposals"):
        # others than those that coverage is measured on
        generator = random_generator(config.seed, "balancing")
        independent = independent_samples(target, config.learning.balance_proposals, generator)
        if not len(independent):
            raise DataError(
                "no ray of the design space reaches a target surface in any training scene",
                where="space",
                hint="widen the angles or the range, move the origin, or raise density.sigma_m",
            )
        refuse_blind_receiver(target.scenes, independent.points)
        # points on the space's faces may leave it by rounding
        unit = config.space.to_unit(independent.points).clip(-1.0, 1.0)
        pool = Pool.of(unit, independent.log_target, independent.log_prob)
        probes = independent_samples(target, STOPPING_POINTS, random_generator(config.seed, "stopping"))
    return TrainingData(target, (*task_notes, *of_lengths, *notes), pool, independent, probes)


def refuse_blind_receiver(scenes: Sequence[Scene], points: np.ndarray) -> None:
    """Refuse scenes whose fixed receiver has none of the points observed by rays (N, 6) in its view.

    Raises:
        DataError: So it is.
    """
    receiver = common_receiver(scenes)
    if receiver is not None and not in_view(receiver, observed_point(points)).any():
        raise DataError(
            "no surface that a ray of the design space reaches lies in its field of view and range",
            where="receiver",
            hint="turn it, widen its field of view or its range, or move it",
        )


def learn(
    task: Task,
    config: RunConfig,
    run: Path,
    *,
    resume: bool = False,
    device: str = "auto",
    progress: Callable[[LearnProgress], None] | None = None,
    is_over: Callable[[Trainer], bool] | None = None,
    remark: Callable[[str], None] | None = None,
) -> LearnResult:
    """Learn the density of a task into a run folder.

    Arguments:
        task: The plugin.
        config: The resolved configuration.
        run: The run folder; its config.yaml is written by the caller.
        resume: Continue from the run's checkpoint; the result is that of an uninterrupted run, bit for bit.
        device: auto, cpu or cuda: where the flow lives, and what of the target can (`device_target`).
        progress: Called about every tenth step.
        is_over: Asked whether time is over; see `Trainer`.
        remark: See `prepare_training_data`.

    Raises:
        ConfigError, DataError: Unusable settings or scenes.
        DivergenceError: Learning stayed non-finite; the last good checkpoint is kept.
    """
    place = choose_device(device)
    with running() as clock, on_one_thread():
        data = prepare_training_data(task, config, remark)
        trainer = make_trainer(data, config, run, place)
        trainer.is_over = is_over
        if resume:
            trainer.resume()
        else:
            (run / PROGRESS).unlink(missing_ok=True)
            clear_snapshots(run)
        with phase("learning"):
            trainer.train(progress)
        learned, generator = trainer.learned(), random_generator(config.seed, "coverage")
        with phase("measuring"):
            probes = independent_samples(trainer.target, config.learning.coverage_proposals, generator)
        measured = measure(learned, probes, config.learning.samples)
        found = mix_samples(learned, measured, data, probes)
        with phase("writing"):
            save_flow(learned.flow, run, FLOW, **asdict(measured.thinning))
            save_samples(found.samples, run)
            if (run / PROGRESS).exists():
                record(run, [PROGRESS])
    result = LearnResult(
        run=str(run),
        task=config.task_name,
        seconds=round(clock.seconds, 3),
        steps=trainer.step,
        notes=(*data.notes, *_notes(trainer, place, config.preset), *measured.notes, *found.notes),
        samples=found.as_dict(),
        timings=clock.timings(),
        error_estimates=measured.estimates,
        **{name: estimate.value for name, estimate in measured.estimates.items()},
    )
    visibility = data.target.visibility.name
    note(run, learn=result.as_dict(), visibility=visibility, round_trip_nats=measured.round_trip_nats)
    return result


@phase("mixing")
def mix_samples(learned: LearnedFlow, measured: MeasuredFlow, data: TrainingData, probes: Samples) -> MixedSamples:
    """The samples of a flow with balancing's independent points, in the share of the largest effective number.

    Arguments:
        learned: The flow.
        measured: Its samples.
        data: What it was learned from.
        probes: Further independent points, by which the share is chosen.
    """
    samples, thinning, space = measured.samples, measured.thinning, measured.samples.space

    def known(drawn: Samples) -> KnownPoints:
        groups = condition_groups(space, drawn.points)
        log_flow = thinning.log_prob(log_density_of(learned, drawn.points), drawn.log_target, groups)
        return KnownPoints(drawn.points, log_flow, drawn.log_prob, drawn.log_target)

    def of_flow(drawn: Samples) -> KnownPoints | None:
        log_density = log_proposal(data.target, drawn.points)
        return None if log_density is None else KnownPoints(drawn.points, drawn.log_prob, log_density, drawn.log_target)

    kept = of_flow(samples)
    if kept is None or min(len(kept), len(probes), len(data.independent)) < FEWEST_PROBES:
        return MixedSamples.of_flow_alone(samples)
    pilot = of_flow(thinning.thinned(draw_samples(learned, PILOTS), learned.generator))
    others = known(probes.subset(slice(PILOTS)))
    return mixed(samples, kept, known(data.independent), (pilot, others))


@contextlib.contextmanager
def on_one_thread() -> Iterator[None]:
    """Set torch to one thread, since sums over several threads round differently."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def draft_note(measured: Sequence[tuple[int, Estimate]], preset: str) -> str | None:
    """A note where learning longer than the preset draft made no significant difference; else None.

    Arguments:
        measured: Misplaced shares by step.
        preset: The preset of the run.
    """
    draft = PRESET_LEARNING["draft"]
    early = [(step, found) for step, found in measured if step <= draft["steps"]]
    if preset == "draft" or not early or early[-1][0] == measured[-1][0]:
        return None
    step, as_draft = next((one for one in early if reaches(one[1], draft["misplaced"])), early[-1])
    last, best = min(measured, key=lambda one: one[1].value)
    if as_draft.value - best.value > math.hypot(as_draft.error or 0.0, best.error or 0.0):
        return None
    return (
        f"--preset {preset} is no better than draft here: {best.value:.2g} of the mass is in the wrong place after "
        f"{last} steps, and {as_draft.value:.2g} after {step}, where draft stops"
    )


def _notes(trainer: Trainer, place: torch.device, preset: str) -> list[str]:
    notes = [] if place.type == "cpu" or isinstance(trainer.target, DeviceTarget) else [ON_PROCESSOR]
    if trainer.skipped:
        notes.append(f"{trainer.skipped} steps were skipped: their loss or gradient was not finite")
    if trainer.doubled_at is not None:
        splines = f"float32 could not invert the flow's splines: float64 was used from step {trainer.doubled_at} on"
        notes.append(BackgroundNote(splines))
    note = None if trainer.stopped else draft_note(trainer.measured, preset)
    return notes if note is None else [*notes, note]


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
def make_trainer(data: TrainingData, config: RunConfig, run: Path, device: torch.device) -> Trainer:
    """A trainer at its first step."""
    generator = torch.Generator().manual_seed(config.seed)
    flow = make_flow(config, generator).to(device=device, dtype=getattr(torch, config.learning.dtype))
    target = data.target if device.type == "cpu" else on_device(data.target, device)
    coordinates, pool = Coordinates(config.space), data.pool.to(device)
    return Trainer(flow, target, coordinates, generator, config.learning, run, pool, data.probes)


def make_flow(config: RunConfig, generator: torch.Generator) -> DesignFlow:
    """The flow of a configuration with its initial weights."""
    coordinates, settings = Coordinates(config.space), config.learning
    return DesignFlow(
        len(coordinates.learned),
        len(coordinates.conditions),
        layers=settings.layers,
        hidden=settings.hidden,
        bins=settings.bins,
        periodic=[config.space.free[n] == AZIMUTH and config.space.full_azimuth for n in coordinates.learned],
        generator=generator,
    )


# Steps and samples that a forecast times.
TIMED_STEPS = 6
TIMED_POINTS = 2048


@phase("planning")
@on_one_thread()
def forecast(
    data: TrainingData, config: RunConfig, run: Path, device: str, time_budget_s: float | None
) -> dict[str, Any]:
    """Time of single steps, the most that all take with the samples after them [s], and the memory held [bytes].

    Nothing is written. A balancing step on a learned density may take longer than on the untrained one that is timed.
    """
    place, learning = choose_device(device), config.learning
    trainer, pathwise = make_trainer(data, config, run, place), learning.pathwise_steps
    pathwise_s = _seconds(lambda: _try_step(trainer, 0)) if pathwise else 0.0
    balancing_s = _seconds(lambda: _try_step(trainer, pathwise))
    sampling_s = _seconds(lambda: draw_samples(trainer.learned(), TIMED_POINTS)) * learning.samples / TIMED_POINTS
    balanced = learning.steps - pathwise
    if time_budget_s is not None:
        in_time = math.ceil((time_budget_s - pathwise * pathwise_s) / balancing_s)
        balanced = min(balanced, max(in_time, least_balancing_steps(pathwise)))
    return {
        "steps": pathwise + balanced,
        "pathwise_s": pathwise_s,
        "balancing_s": balancing_s,
        "seconds": pathwise * pathwise_s + balanced * balancing_s + sampling_s,
        "peak_memory_bytes": peak_memory_bytes(),
        "gpu_memory_bytes": torch.cuda.max_memory_allocated(place) if place.type == "cuda" else None,
    }


def _try_step(trainer: Trainer, step: int) -> None:
    trainer.step = step
    trainer.find_gradient()


def _seconds(call: Callable[[], object]) -> float:
    """Mean time of a call [s], without the first one, which may have to compile."""
    call()
    started = time.perf_counter()
    for _ in range(TIMED_STEPS):
        call()
    return (time.perf_counter() - started) / TIMED_STEPS
