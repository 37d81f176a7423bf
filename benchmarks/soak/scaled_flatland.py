"""Flatland of any size at any place: the plugin that random runs learn, found through its entry point as others are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from lidardesign_tasks.flatland import ITEMS, TRUTH_STEP_M, FlatlandConfig, FlatlandTask, in_space, reconstruct_curve
from pydantic import Field

from lidardesign.rays.information import surface_information
from lidardesign.scenes.rays import Returns
from lidardesign.scenes.scene import Body, Scene
from lidardesign.scoring.metrics import chamfer_m
from lidardesign.space import DesignSpace
from lidardesign.task import Defaults, Information, Metric, Score, Split

NAME = "scaled-flatland"
PERMILLE = 1000.0


class ScaledFlatlandConfig(FlatlandConfig):
    """Flatland's configuration, and where its unit square lies."""

    size_m: float = Field(1.0, gt=0, description="width of the scenes [m]")
    offset_m: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="where their corner is [m]")


class ScaledFlatlandTask:
    """Flatland's scenes, grown about their corner and moved; scores are shares of their width."""

    name: ClassVar[str] = NAME
    summary: ClassVar[str] = "flatland of any size at any place"
    api_version: ClassVar[int] = 1
    Config: ClassVar[type[ScaledFlatlandConfig]] = ScaledFlatlandConfig
    metric: ClassVar[Metric] = Metric("Chamfer distance", "permille of the width", "lower", worst=500.0, tolerance=0.5)
    defaults: ClassVar[Defaults] = replace(FlatlandTask.defaults, density={})

    def space(self, config: ScaledFlatlandConfig) -> DesignSpace:
        """Flatland's three free dimensions."""
        home = FlatlandTask().space(config)
        offset = np.array([*config.offset_m, 0.0, 0.0, 0.0])
        return DesignSpace(*(tuple(_lengths(config.size_m) * bounds + offset) for bounds in (home.low, home.high)))

    def scenes(
        self, config: ScaledFlatlandConfig, split: Split, seed: int, space: DesignSpace | None = None
    ) -> Sequence[Scene]:
        """Flatland's scenes, made at home as the space there would see them; their truth stays at home."""
        scenes = FlatlandTask().scenes(config, split, seed, self._home(space or self.space(config), config))
        return [self._moved(scene, config) for scene in scenes]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Flatland's distance of the returns as they are at home."""
        points = np.concatenate([frame.points_m for frame in returns])
        curve = reconstruct_curve(((points - scene.truth["offset_m"]) / scene.truth["size_m"])[:, :2])
        if curve is None or not len(scene.truth["curve_m"]):
            return Score(self.metric.worst, failed=True)
        return Score(min(PERMILLE * chamfer_m(curve, scene.truth["curve_m"]), self.metric.worst))

    def informs(self, scene: Scene, returns: Sequence[Returns], share: float) -> Information:
        """Flatland's information, of the curve where it was moved to."""
        curve = in_space(scene.truth["curve_m"])
        points = curve[np.linspace(0, len(curve) - 1, min(ITEMS, len(curve))).astype(int)]
        moved = scene.truth["size_m"] * points + scene.truth["offset_m"]
        length_m = scene.truth["size_m"] * TRUTH_STEP_M * len(curve) * len(returns)
        is_target = [body.is_target for body in scene.bodies]
        points_m = [moved] * len(returns)
        return surface_information(points_m, returns, is_target, length_m, dimensions=1, share=share)

    @staticmethod
    def _home(space: DesignSpace, config: ScaledFlatlandConfig) -> DesignSpace:
        offset = np.array([*config.offset_m, 0.0, 0.0, 0.0])
        low, high = ((np.array(bounds) - offset) / _lengths(config.size_m) for bounds in (space.low, space.high))
        return DesignSpace(tuple(low), tuple(high), measure=space.measure)

    @staticmethod
    def _moved(scene: Scene, config: ScaledFlatlandConfig) -> Scene:
        truth = {**scene.truth, "size_m": config.size_m, "offset_m": np.array(config.offset_m)}
        return replace(scene, bodies=tuple(_grown(body, config) for body in scene.bodies), truth=truth)


def offer(folder: Path) -> Path:
    """Write what an installed package would: with this folder, which is given back, on the path, the task is found."""
    made = folder / "lidardesign_soak-1.0.dist-info"
    made.mkdir(parents=True, exist_ok=True)
    (made / "METADATA").write_text("Metadata-Version: 2.1\nName: lidardesign-soak\nVersion: 1.0\n")
    offered = f"{NAME} = {__name__}:{ScaledFlatlandTask.__name__}"
    (made / "entry_points.txt").write_text(f"[lidardesign.tasks]\n{offered}\n")
    return folder


def _lengths(size_m: float) -> np.ndarray:
    """What the six dimensions are multiplied by, shape (6,): angles stay."""
    return np.array([size_m, size_m, size_m, 1.0, 1.0, size_m])


def _grown(body: Body, config: ScaledFlatlandConfig) -> Body:
    size, shape = config.size_m, body.shape
    grown = type(shape)(*(size * length_m for length_m in vars(shape).values()))
    pose = body.pose().copy()
    pose[:3, 3] = size * pose[:3, 3] + np.array(config.offset_m)
    return replace(body, shape=grown, poses=pose)
