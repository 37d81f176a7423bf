"""Scanning shelves from a robot that drives past them, with elevations of rays that depend on its position.

World frame: the robot drives along x with its sensor at y = z = 0 and looks towards -y, up to straight up. The
shelf stands along the aisle with four levels of boxes; see `warehouse_shelf` for its shape. A design gives the
rays for any robot position x; its score is the share of boxes that it misses there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from lidardesign import (
    DIMENSIONS,
    ConfigError,
    Defaults,
    DesignSpace,
    Information,
    Interval,
    Metric,
    Returns,
    Scene,
    Score,
    Split,
    random_generator,
)
from lidardesign_tasks.surroundings import Surroundings
from lidardesign_tasks.warehouse_shelf import ShelfPlan, build_shelf
from lidardesign_tasks.warehouse_truth import BoxTruth, box_information, miss_score

AISLE_M = (-0.5, 4.0)
PAPER_POSITIONS_M = (0.0, 1.2, 2.4, 3.6)
# The density is conditioned on x; rays in one vertical plane need the others fixed.
X = DIMENSIONS.index("x_m")
FIXED_DIMENSIONS = ("y_m", "z_m", "azimuth_rad")
MAXIMUM_DRAWS = 100  # attempts to draw a shelf with a visible box

Size = Literal["full", "small"]
SIZES: dict[str, dict[str, int]] = {
    "full": {"train": 100, "test": 40, "positions": 20, "bays": 4},
    "small": {"train": 6, "test": 4, "positions": 4, "bays": 2},
}


class WarehouseConfig(Surroundings):
    """Number and variation of shelves, robot positions, and the surroundings."""

    size: Size = Field("full", description="small: 6 training and 4 held-out shelves of 2 bays, for quick checks")
    train: int | None = Field(None, ge=1, le=10_000, description="training shelves; default 100, small 6")
    test: int | None = Field(None, ge=1, le=10_000, description="held-out shelves; default 40, small 4")
    positions: int | None = Field(
        None, ge=0, le=1000, description="robot positions in addition to 0, 1.2, 2.4, 3.6 m; default 20, small 4"
    )
    bays: int | None = Field(None, ge=1, le=20, description="bays along the aisle; default 4, small 2")
    front_m: Interval = Field(
        (0.9, 1.1), description="mean distance to the shelf where the aisle starts and where it ends [m]"
    )
    front_jitter_m: float = Field(0.04, ge=0, le=0.2, description="half width of both distances' spread [m]")
    first_level_m: Interval = Field((0.05, 0.15), description="height of the lowest level above the sensor [m]")
    level_spacing_m: Interval = Field((0.46, 0.56), description="height from one level to the next [m]")
    box_width_m: Interval = Field((0.2, 0.6), description="shortest and longest box along the aisle [m]")
    box_height_m: Interval = Field((0.05, 0.38), description="lowest and highest box [m]")
    box_setback_m: Interval = Field((0.0, 0.05), description="from the shelf's edge to the boxes' fronts [m]")
    empty_share: float = Field(0.15, ge=0, le=0.9, description="share of boxes with an empty place beside them")
    second_row_share: float = Field(0.15, ge=0, le=1, description="share of boxes with another one behind them")
    speed_m_s: float = Field(0.0, ge=0, le=100, description="how fast the robot drives along the aisle [m/s]")

    @model_validator(mode="after")
    def _check_the_plan(self) -> WarehouseConfig:
        self.plan.check()
        return self

    def count(self, name: Literal["train", "test", "positions", "bays"]) -> int:
        """The configured number of things, or the default of the size."""
        value = getattr(self, name)
        return SIZES[self.size][name] if value is None else value

    @property
    def plan(self) -> ShelfPlan:
        """Distribution of random shelves."""
        return ShelfPlan(
            aisle_m=AISLE_M,
            bays=self.count("bays"),
            front_m=self.front_m,
            front_jitter_m=self.front_jitter_m,
            first_level_m=self.first_level_m,
            level_spacing_m=self.level_spacing_m,
            box_width_m=self.box_width_m,
            box_height_m=self.box_height_m,
            box_setback_m=self.box_setback_m,
            empty_share=self.empty_share,
            second_row_share=self.second_row_share,
        )


class WarehouseTask:
    """See every box on the shelves that a robot drives past, with few rays per position."""

    name: ClassVar[str] = "warehouse"
    summary: ClassVar[str] = "a robot drives past shelves of boxes; rays for any position along the aisle"
    api_version: ClassVar[int] = 1
    Config: ClassVar[type[WarehouseConfig]] = WarehouseConfig
    metric: ClassVar[Metric] = Metric("miss rate", "%", "lower", worst=100.0, tolerance=0.5)
    defaults: ClassVar[Defaults] = Defaults(rays=(6, 12, 18), density={"sigma_m": 0.02})

    def space(self, config: WarehouseConfig) -> DesignSpace:
        """Elevation and range in the vertical plane y < 0, conditioned on the robot's x.

        Rays that stay in a plane are counted per plane angle: per solid angle, as for a sensor that also turns, a
        degree of elevation would count for less the higher it looks, although no ray can leave the plane.
        """
        return DesignSpace(
            low=(AISLE_M[0], 0.0, 0.0, -math.pi / 2, 0.0, 0.1),
            high=(AISLE_M[1], 0.0, 0.0, -math.pi / 2, math.pi / 2, 5.0),
            condition=("x_m",),
            measure="angles",
        )

    def conditions(self, config: WarehouseConfig) -> list[dict[str, float]]:
        """The paper's four robot positions, then `positions` more, evenly over the aisle."""
        count = config.count("positions")
        more = AISLE_M[0] + (np.arange(count) + 0.5) / max(count, 1) * (AISLE_M[1] - AISLE_M[0])
        return [{"x_m": float(x)} for x in (*PAPER_POSITIONS_M, *more)]

    def scenes(
        self, config: WarehouseConfig, split: Split, seed: int, space: DesignSpace | None = None
    ) -> Sequence[Scene]:
        """Random shelves; each has a generator of its own, so counts do not change them.

        Raises:
            ConfigError: The space is no vertical plane along the aisle, or no box can be seen in it.
        """
        space = space or self.space(config)
        _check_space(space)
        origins = [space.at(one).low[:3] for one in (self.conditions(config) if space.conditioned else [{}])]
        shelves = [
            _visible_shelf(config.plan, space, np.array(origins), split, seed, index)
            for index in range(config.count(split))
        ]
        # the shelf moves relative to the driving robot
        return [config.around(shelf, (-config.speed_m_s, 0.0, 0.0)) for shelf in shelves]

    def score(self, scene: Scene, returns: Sequence[Returns]) -> Score:
        """Share of visible boxes in the sensor's plane without a return [%]; one `Returns` per position."""
        return miss_score(self.metric, scene, returns)

    def informs(self, scene: Scene, returns: Sequence[Returns]) -> Information:
        """Information of returns on boxes that are visible from their position."""
        return box_information(scene, returns)


def _check_space(space: DesignSpace) -> None:
    """Refuse spaces without a single vertical plane per robot position."""
    for name in FIXED_DIMENSIONS:
        if DIMENSIONS.index(name) in space.free:
            raise ConfigError(
                f"{name} is free, but the warehouse scores rays in one vertical plane per robot position",
                where=f"space.{name}",
                hint="fix it to one number",
            )
    if X in space.free and X not in space.conditioned:
        raise ConfigError(
            "x_m is free, but designs are scored at given robot positions", where="space.condition", allowed="x_m"
        )
    low, high = space.low[X], space.high[X]
    if (low, high) != AISLE_M and not (X not in space.free and AISLE_M[0] <= low <= AISLE_M[1]):
        raise ConfigError(
            f"x from {low:g} to {high:g} m",
            where="space.x_m",
            allowed=f"{AISLE_M[0]:g} to {AISLE_M[1]:g} m, where designs are evaluated, or one number between them",
        )


def _visible_shelf(
    plan: ShelfPlan, space: DesignSpace, origins_m: np.ndarray, split: Split, seed: int, index: int
) -> Scene:
    """A random shelf with its truth, drawn again while no box is visible from any position."""
    for draw in range(MAXIMUM_DRAWS):
        generator = random_generator(seed, "warehouse", split, index, draw)
        scene = Scene(build_shelf(plan, generator), f"{split} shelf {index}")
        truth = BoxTruth(scene, space, origins_m)
        if truth.any_visible():
            return Scene(scene.bodies, scene.name, truth)
    raise ConfigError(
        f"no box of {MAXIMUM_DRAWS} random shelves can be seen from any robot position",
        where="task",
        hint="bring the boxes' fronts to the shelf's edge or widen the design space",
    )
