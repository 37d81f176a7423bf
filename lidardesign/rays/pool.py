"""Information of candidate rays about training scenes: computed once, cached in the run, and reused by later fits.

Where origins are given a change of constraints changes neither the scenes nor the returns there. So rays are drawn from
the whole density, more than any design chooses from, and a fit picks those inside its sensors. Where origins are free
the candidates of the last fit are kept for another bandwidth or other gates. The file has a hash of all that it depends
on: with other rays, another mesh, setting, seed or version of the program or the task it is computed anew, and cached
information is bit for bit that computed without the cache.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import io
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lidardesign import __file__ as package_file
from lidardesign.errors import LidardesignError
from lidardesign.rays.gates import gate_choices
from lidardesign.rays.information import CHOSEN_SHARE, MOST_SELECTED
from lidardesign.rays.proposals import CANDIDATES_PER_RAY, draw_order, nearest_samples
from lidardesign.rays.selection import Selection, inform_enough
from lidardesign.rays.training_scenes import SceneInformation, TrainingScenes
from lidardesign.run.arrays import read_npz
from lidardesign.run.clock import phase
from lidardesign.run.files import write_atomic
from lidardesign.run.inputs import SAMPLES
from lidardesign.run.manifest import locked_run, versions
from lidardesign.run_folder import RunFolder, input_hashes
from lidardesign.samples import Samples
from lidardesign.scenes.rays import Rays
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, direction
from lidardesign.task import TASKS, random_generator

FILE_NAME = "informed.npz"
# So many times as many rays as are chosen from at the task's largest number: sensors see a part of them each.
POOL_FACTOR = 3
MOST_BYTES = 300_000_000


@dataclass(frozen=True, eq=False)
class CandidatePool:
    """Rays drawn from the whole density, with their information.

    Arguments:
        points: Their design points, shape (N, 6), in an order in which any first few are a fair draw.
        visits: Slices of them at each value of the condition.
        informed: Information about the scenes that rays are chosen on.
        held_back: Information about scenes that are held back.
    """

    points: np.ndarray
    visits: Sequence[slice]
    informed: Sequence[SceneInformation]
    held_back: Sequence[SceneInformation]


@phase("pool")
def pool_of(
    run: RunFolder, samples: Samples, training: TrainingScenes, progress: Callable[[str], None]
) -> CandidatePool:
    """The pool of a run: rays drawn from the whole density, with their information.

    Arguments:
        run: The run, whose sensors stand at one place but for conditions.
        samples: Of its density.
        training: Its training scenes.
        progress: Called with every step.

    Raises:
        InfeasibleError: No ray has information about the scenes.
    """
    conditions, counts = run.conditions(), sorted(run.task.defaults.rays)
    size = POOL_FACTOR * CANDIDATES_PER_RAY * min(counts[-1], MOST_SELECTED)
    parts = []
    for number, at in enumerate(conditions):
        near = nearest_samples(samples, at)
        order = draw_order(near.weights, random_generator(training.seed, "pool", number))
        _, first = np.unique(near.points[order, :RANGE], axis=0, return_index=True)
        parts.append(near.points[order[np.sort(first)[:size]]])
    ends = np.cumsum([0, *map(len, parts)]).tolist()
    points, visits = np.concatenate(parts), [slice(*pair) for pair in itertools.pairwise(ends)]
    gate_m = np.tile([run.config.space.low[RANGE], run.config.space.high[RANGE]], (len(points), 1))
    looking = direction(points[:, AZIMUTH], points[:, ELEVATION])
    rays = Rays(points[:, :3], looking, gate_m, np.zeros(len(points)), np.zeros(len(points)))
    gates, share = partial(gate_choices, margin_m=training.margin_m), CHOSEN_SHARE / POOL_FACTOR
    selection = Selection(rays, visits, gates, Bandwidth(), share=share)
    return CandidatePool(points, visits, *cached_information(selection, training, counts[len(counts) // 2], progress))


def cached_information(
    selection: Selection, training: TrainingScenes, count: int, progress: Callable[[str], None]
) -> tuple[list[SceneInformation], list[SceneInformation]]:
    """As `inform_enough`: from the run's cache, else computed and cached where it can be written."""
    run = training.run
    path, key = run.folder / FILE_NAME, _key(selection, training, count)
    with contextlib.suppress(LidardesignError, KeyError, ValueError):
        arrays = read_npz(path, SAMPLES)
        if bytes(arrays["key"]).decode() == key:
            return _unpacked(arrays)
    informed, held_back = inform_enough(selection, training, count, progress)
    arrays = _packed(informed, held_back, len(selection.rays))
    buffer = io.BytesIO()
    np.savez(buffer, key=np.frombuffer(key.encode(), dtype=np.uint8), **arrays)
    if buffer.tell() <= MOST_BYTES:
        # a run that is gone or cannot be written, or a full disk, costs time alone
        with contextlib.suppress(LidardesignError), locked_run(run.folder, run.created, wait_s=0.0):
            write_atomic(path, buffer.getvalue())
    # rounded as the file rounds it
    return _unpacked(arrays)


def _key(selection: Selection, training: TrainingScenes, count: int) -> str:
    """A hash of everything that information depends on."""
    run, rays = training.run, selection.rays
    task = type(run.task)
    source = inspect.getsourcefile(task)
    folders = [Path(package_file).parent, *([Path(source).parent] if source else [])]
    sources = [(str(path), path.stat()) for folder in folders for path in sorted(folder.rglob("*.py"))]
    made_of = {
        "config": run.config.as_document(),
        "inputs": input_hashes(run.config.task),
        "rays": [
            hashlib.sha256(column.tobytes()).hexdigest() for column in (rays.origin_m, rays.direction, rays.gate_m)
        ],
        "visits": [(visit.start, visit.stop) for visit in selection.visits],
        "asked": [count, selection.share],
        "seed": training.seed,
        "versions": versions(),
        "task": [TASKS.distribution_of(run.task.name), task.__module__, task.__qualname__],
        # a version says nothing of sources under development
        "source": [(name, state.st_size, state.st_mtime_ns) for name, state in sources],
    }
    return hashlib.sha256(json.dumps(made_of, sort_keys=True, default=str).encode()).hexdigest()


def _packed(
    informed: Sequence[SceneInformation], held_back: Sequence[SceneInformation], rays: int
) -> dict[str, np.ndarray]:
    """The arrays of all scenes one after the other, and where each begins."""
    scenes = [*informed, *held_back]
    small = np.uint16 if rays <= np.iinfo(np.uint16).max else np.int32
    kinds = {
        "ray": small,
        "item": np.uint16,
        "worth": np.float32,
        "range_m": np.float32,
        "weight": np.float64,
        "spoiling": small,
        "harm": np.float32,
        "harm_range_m": np.float32,
    }
    arrays = {
        name: np.concatenate([np.asarray(getattr(scene, name)) for scene in scenes]).astype(kind)
        for name, kind in kinds.items()
    }
    sizes = [[len(scene.ray), len(scene.weight), len(scene.spoiling)] for scene in scenes]
    first = scenes[0]
    return {
        **arrays,
        "starts": np.concatenate([np.zeros((1, 3), dtype=np.int64), np.cumsum(sizes, axis=0)]),
        "complete": np.array([scene.complete for scene in scenes]),
        "chosen_on": np.array(len(informed)),
        "sums": first.sums,
        "is_repeated": np.array(first.is_repeated),
        "unit": np.frombuffer(first.unit.encode(), dtype=np.uint8),
    }


def _unpacked(arrays: Mapping[str, np.ndarray]) -> tuple[list[SceneInformation], list[SceneInformation]]:
    scenes, starts = [], arrays["starts"]
    shared = {
        "sums": arrays["sums"],
        "is_repeated": bool(arrays["is_repeated"]),
        "unit": bytes(arrays["unit"]).decode(),
    }
    for number, complete in enumerate(arrays["complete"].tolist()):
        entries, items, spoils = (slice(*starts[number : number + 2, kind]) for kind in range(3))
        scenes.append(
            SceneInformation(
                ray=arrays["ray"][entries].astype(np.int32),
                item=arrays["item"][entries].astype(np.int32),
                worth=arrays["worth"][entries],
                range_m=arrays["range_m"][entries].astype(np.float64),
                weight=arrays["weight"][items],
                spoiling=arrays["spoiling"][spoils].astype(np.intp),
                harm=arrays["harm"][spoils].astype(np.float64),
                harm_range_m=arrays["harm_range_m"][spoils].astype(np.float64),
                complete=complete,
                **shared,
            )
        )
    chosen_on = int(arrays["chosen_on"])
    return scenes[:chosen_on], scenes[chosen_on:]
