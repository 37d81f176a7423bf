"""What one random run does: a valid configuration, a fit, constraints and an evaluation, all from one number."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.soak.scaled_flatland import NAME, ScaledFlatlandConfig, ScaledFlatlandTask
from lidardesign.scenes.scene import Body, Capsule
from lidardesign.space import DIMENSIONS, DesignSpace, observed_point
from lidardesign.task import random_generator

# What the soak promises to cover, as powers of ten: the width of the scenes, and sigma as a share of it.
SIZES_M = (-3.0, 4.0)
SIGMA_SHARES = (-4.0, 0.0)
MOST_SENSORS = 12
# Below this share of the width a sigma is narrow.
FINE_SHARE = 0.02
# Shipped detectors that count photons, and how far their histograms or pulses reach [m].
DETECTORS = {"single-photon": 14.9, "consumer-8x8": 4.79}
# Where a dimension stands when it is fixed, at home: in the middle of the line below, looking up at the curve.
FIXED = {"x_m": 0.5, "y_m": 0.0, "z_m": 0.0, "azimuth_rad": math.pi / 2, "elevation_rad": 0.0}
# Bounds of a free one; of these, one is drawn.
FREE: dict[str, list[tuple[float, float]]] = {
    "x_m": [(0.0, 1.0), (0.2, 0.7)],
    "y_m": [(-0.2, 0.2), (0.0, 0.1)],
    "z_m": [(-0.1, 0.1), (0.0, 0.3)],
    "azimuth_rad": [(math.pi / 4, 3 * math.pi / 4), (0.0, 2 * math.pi), (-math.pi, math.pi), (0.0, math.pi)],
    "elevation_rad": [(-0.3, 0.3), (-math.pi / 2, math.pi / 2), (-0.5, 0.1)],
    "range_m": [(0.0, 1.2), (0.3, 1.0)],
}


@dataclass(frozen=True)
class RunPlan:
    """One random run: the configuration of `learn`, how many sensors, and options of `fit` and `evaluate`."""

    seed: int
    config: dict[str, Any]
    sensors: int
    layout: str
    fit: tuple[str, ...]
    evaluate: tuple[str, ...]

    @property
    def size_m(self) -> float:
        """Width of the scenes [m]."""
        return self.config["task"]["size_m"]

    @property
    def sigma_share(self) -> float:
        """Sigma as a share of that width."""
        return self.config["density"]["sigma_m"] / self.size_m

    @property
    def is_moving(self) -> bool:
        """Whether its designs are for all values of a condition."""
        return "condition" in self.config["space"] and "--at" not in self.fit

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the free dimensions."""
        return tuple(name for name in DIMENSIONS if isinstance(self.config["space"][name], list))


def random_plan(seed: int) -> RunPlan:
    """The run of a number, always the same."""
    generator = random_generator(seed, "soak", "plan")
    size = _power(generator, *SIZES_M)
    offset = [float(v) for v in size * _pick(generator, [0.0, 1.0, 100.0]) * generator.normal(size=3)]
    space, density = _space(generator, size, offset), _density(generator, size)
    # designs are for one value of the density's condition, or for all
    at = ("--at", f"x_m={float(generator.uniform(*space['x_m']))!r}") if "condition" in space else ()
    at = _pick(generator, [at, ()])
    layout = _pick(generator, ["even", "chosen", "chosen"])
    sensors = int(generator.integers(1, MOST_SENSORS + 1))
    return RunPlan(
        seed,
        {
            "task_name": NAME,
            "task": {**_scenes(generator, size), "size_m": size, "offset_m": offset},
            "space": space,
            "density": density,
            "learning": _affordable(_learning(generator, is_fine=density["sigma_m"] < FINE_SHARE * size), density),
        },
        sensors,
        layout,
        (*_fit_options(generator, layout, sensors), *at),
        _evaluate_options(generator, layout, reach_m=np.max(space["range_m"])),
    )


def _power(generator: np.random.Generator, low: float, high: float) -> float:
    """Ten to the power of an even draw, with digits that a person would write."""
    return float(f"{10 ** generator.uniform(low, high):.4g}")


def _pick(generator: np.random.Generator, choices: list[Any]) -> Any:
    return choices[int(generator.integers(len(choices)))]


def _space(generator: np.random.Generator, size: float, offset: list[float]) -> dict[str, Any]:
    count = int(generator.integers(1, 7))
    # a design space of one range has gates without a width
    free = {"range_m", *(DIMENSIONS[i] for i in generator.permutation(5)[: count - 1])}
    space: dict[str, Any] = {}
    for name in DIMENSIONS:
        shift = dict(zip(DIMENSIONS, offset, strict=False)).get(name, 0.0)
        unit = size if name.endswith("_m") else 1.0
        if name in free:
            space[name] = [shift + unit * bound for bound in _pick(generator, FREE[name])]
        else:
            space[name] = shift + unit * FIXED[name]
    space["measure"] = _pick(generator, ["solid_angle", "solid_angle", "angles"])
    if "x_m" in free and count > 1 and generator.random() < 0.15:
        space["condition"] = ["x_m"]
    return space


def _scenes(generator: np.random.Generator, size: float) -> dict[str, Any]:
    scenes: dict[str, Any] = {
        "scene": _pick(generator, ["surface", "discs", "occluded"]),
        "train": int(generator.integers(1, 7)),
        "test": int(generator.integers(1, 4)),
        "variation": float(generator.uniform(0.1, 1.5)),
        "illuminance_lux": _pick(generator, [0.0, 300.0, 100_000.0]),
        "light": _pick(generator, ["indoor", "sun"]),
        "reflectance": float(generator.uniform(0.02, 1.0)),
        "gloss": _pick(generator, [0.0, 0.0, 0.5]),
    }
    if generator.random() < 0.2:
        scenes["visibility_m"] = max(size * _power(generator, 0.0, 2.0), 0.01)
    return scenes


def _density(generator: np.random.Generator, size: float) -> dict[str, Any]:
    share = _power(generator, *SIGMA_SHARES)
    # a narrow sigma asks the quadrature for thousands of points: minutes
    wide_only = "quadrature" if share >= FINE_SHARE else "auto"
    density: dict[str, Any] = {
        "sigma_m": size * share,
        "visibility": _pick(generator, ["auto", "auto", "raycast", wide_only, "off"]),
        "quadrature_points": int(_pick(generator, [8, 32])),
    }
    for name in ("attenuation_per_m", "sharpness_per_m"):
        if generator.random() < 0.3:
            density[name] = _power(generator, 0.0, 4.0) / size
    if generator.random() < 0.3:
        density["margin_m"] = size * _pick(generator, [0.0, 0.001, 0.05])
    return density


# What learns most densities in seconds, and what else may be asked for.
USUAL_LEARNING: dict[str, Any] = {
    "steps": 60, "batch": 256, "rate": 0.01, "layers": 3, "hidden": 48, "bins": 16, "samples": 8000,
    "balance_proposals": 8192, "coverage_proposals": 512,
}  # fmt: skip
# With a narrow sigma these are needed for a density that is worth fitting to.
FINE_LEARNING: dict[str, Any] = {"steps": 120, "samples": 20_000}
UNUSUAL_LEARNING: dict[str, list[Any]] = {
    "steps": [1, 20, 300], "batch": [2, 32, 512], "rate": [0.001, 0.05], "layers": [1, 2, 4], "hidden": [4, 16, 96],
    "bins": [2, 8], "samples": [1000, 30_000], "balance_proposals": [256, 4096], "dtype": ["float64"],
    "entropy": [0.3], "misplaced": [0.0, 0.5], "pathwise": [0, 1000], "clip_norm": [0.1],
}  # fmt: skip
UNUSUAL_SHARE = 0.1


def _learning(generator: np.random.Generator, *, is_fine: bool) -> dict[str, Any]:
    unusual = {k: _pick(generator, v) for k, v in UNUSUAL_LEARNING.items() if generator.random() < UNUSUAL_SHARE}
    return {**USUAL_LEARNING, **(FINE_LEARNING if is_fine else {}), **unusual}


def _affordable(learning: dict[str, Any], density: dict[str, Any]) -> dict[str, Any]:
    """Less of it with the quadrature, whose every step costs a second."""
    if density["visibility"] != "quadrature":
        return learning
    return {**learning, "steps": min(learning["steps"], 20), "batch": min(learning["batch"], 64), "samples": 3000}


def _fit_options(generator: np.random.Generator, layout: str, sensors: int) -> tuple[str, ...]:
    options = ["--layout", layout, "--level", f"{_pick(generator, [0.5, 0.9, 0.95, 0.99])}"]
    options += ["--sensors", _pick(generator, [str(sensors)] * 5 + ["best"])]
    if generator.random() < 0.5:
        options += ["--rays", str(int(generator.integers(MOST_SENSORS, 65)))]
    if layout == "chosen" and generator.random() < 0.3:
        options += ["--gates", _pick(generator, ["sensor", "ray"])]
    return tuple(options)


def _evaluate_options(generator: np.random.Generator, layout: str, *, reach_m: float) -> tuple[str, ...]:
    detectors = ["ideal", *(name for name, farthest_m in DETECTORS.items() if reach_m < farthest_m)]
    effects = _pick(generator, ["auto", "auto", "none", "all"])
    options = ["--detector", _pick(generator, detectors), "--effects", effects]
    if layout == "even":  # others fire what they were chosen for
        options += ["--rays", str(int(generator.integers(1, 65)))]
    if generator.random() < 0.2:
        options += ["--baseline", _pick(generator, ["occupancy", "no-visibility"])]
    return tuple(options)


POINTS = 20_000


def share_in_targets(plan: RunPlan) -> float:
    """The share of even design points whose scene point lies in a target of any training scene: rays reach it."""
    space = DesignSpace.from_dict({"condition": (), **plan.config["space"]})
    config = ScaledFlatlandConfig.model_validate(plan.config["task"])
    scenes = ScaledFlatlandTask().scenes(config, "train", plan.seed, space)
    points = observed_point(space.sample(POINTS, random_generator(plan.seed, "soak", "sight")))
    targets = [body for scene in scenes for body in scene.bodies if body.is_target]
    return float(np.any([_signed_distance(body, points) < 0 for body in targets], axis=0).mean())


def _signed_distance(body: Body, points: np.ndarray) -> np.ndarray:
    pose = body.pose()
    half_length = body.shape.half_length_m if isinstance(body.shape, Capsule) else 0.0
    offset = points - pose[:3, 3]
    along = np.clip(offset @ pose[:3, 2], -half_length, half_length)
    return np.linalg.norm(offset - along[:, None] * pose[:3, 2], axis=1) - body.shape.radius_m
