"""Random shelves: four boards along the aisle on upright poles, with boxes standing close to the front edge.

The shelf's own frame has u along the aisle, depth into the shelf and z up; its front edge is depth = 0. All bodies
are boxes with a vertical axis. Boards and poles only occlude; boxes are targets and occlude as well. Poles are
just before the front edge, so they hide boxes behind them; a board hides the foot of a box that is set back
from the edge, the more the higher the level; a box hides the second row behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from lidardesign import Body, Box, Interval, rigid

LEVELS = 4
BOARD_THICKNESS_M = 0.06  # the board with the beam that carries it
SHELF_DEPTH_M = 0.6
POLE_M = 0.05  # width and depth of an upright
FLOOR_M = -0.2  # height of the floor: the robot's sensor is 0.2 m above it
BAY_STRETCH = (0.9, 1.15)  # bays of one shelf are the same, those of another this much shorter or longer
BOX_DEPTH_M = (0.2, 0.4)
NARROW_GAP_M = (0.005, 0.03)
EMPTY_PLACE_M = (0.1, 0.5)
BEHIND_GAP_M = (0.01, 0.05)
SHALLOWEST_M = 0.1  # a box of the second row is at least so deep
FURTHEST_BACK_M = 0.05  # with the deepest box, the widest gap and the shallowest box behind it the board is full
WIDEST_BOX_M = 1.0
NEAREST_FRONT_M, FURTHEST_FRONT_M = 0.3, 4.0
STEEPEST_AISLE = 0.2  # metres of distance per metre of aisle
# The shelf extends beyond both ends of the aisle: a box that does not fit at its end is left out, and the positions
# that the robot sees are as full there as elsewhere.
BEYOND_AISLE_M = 0.65


@dataclass(frozen=True)
class ShelfPlan:
    """Distribution of random shelves, uniform within every interval; see `WarehouseConfig` for the fields."""

    aisle_m: Interval
    bays: int
    front_m: Interval
    front_jitter_m: float
    first_level_m: Interval
    level_spacing_m: Interval
    box_width_m: Interval
    box_height_m: Interval
    box_setback_m: Interval
    empty_share: float
    second_row_share: float

    def check(self) -> None:
        """Refuse a plan that cannot be built.

        Raises:
            ValueError: An interval that is reversed or not positive, boxes that do not fit between or on boards, a
                shelf that reaches the robot's path.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple) and field.name not in ("front_m", "aisle_m") and value[0] > value[1]:
                raise ValueError(f"{field.name}: {value[0]} is above {value[1]}")
        self._check_the_boxes()
        self._check_the_front()

    def _check_the_boxes(self) -> None:
        for name in ("box_width_m", "box_height_m"):
            if getattr(self, name)[0] <= 0:
                raise ValueError(f"{name}: {getattr(self, name)[0]} m, allowed: above 0 m")
        if self.box_width_m[1] > WIDEST_BOX_M:
            raise ValueError(f"box_width_m: boxes of {self.box_width_m[1]} m, allowed: up to {WIDEST_BOX_M} m")
        clear = self.level_spacing_m[0] - BOARD_THICKNESS_M
        if self.box_height_m[1] >= clear:
            raise ValueError(
                f"box_height_m: boxes of {self.box_height_m[1]} m do not fit between levels "
                f"{self.level_spacing_m[0]} m apart, allowed: below {clear:.3f} m"
            )
        if self.box_setback_m[0] < 0 or self.box_setback_m[1] > FURTHEST_BACK_M:
            raise ValueError(f"box_setback_m: {self.box_setback_m}, allowed: 0 to {FURTHEST_BACK_M} m")

    def _check_the_front(self) -> None:
        nearest = min(self.front_m) - self.front_jitter_m
        if nearest < NEAREST_FRONT_M or max(self.front_m) > FURTHEST_FRONT_M:
            raise ValueError(
                f"front_m: {self.front_m} with a jitter of {self.front_jitter_m} m, "
                f"allowed: {NEAREST_FRONT_M} to {FURTHEST_FRONT_M} m"
            )
        length = self.aisle_m[1] - self.aisle_m[0]
        steepest = (abs(self.front_m[1] - self.front_m[0]) + 2 * self.front_jitter_m) / length
        if steepest > STEEPEST_AISLE:
            raise ValueError(
                f"front_m: the distance changes by up to {steepest:.2f} m per metre, allowed: {STEEPEST_AISLE}"
            )


@dataclass(frozen=True)
class _Block:
    """A box in the shelf's own frame, by its bounds along the aisle, in depth and in height [m]."""

    along: Interval
    depth: Interval
    height: Interval

    def body(self, name: str, role: Literal["occluder", "both"], pose: np.ndarray) -> Body:
        """The block as a body in the world, for a pose of the shelf whose -y is depth."""
        low = np.array([self.along[0], -self.depth[1], self.height[0]])
        high = np.array([self.along[1], -self.depth[0], self.height[1]])
        half = (high - low) / 2
        return Body(Box(tuple(half.tolist())), name, role, pose @ rigid(translation_m=(low + high) / 2))


def build_shelf(plan: ShelfPlan, generator: np.random.Generator) -> tuple[Body, ...]:
    """Boards, poles and boxes of a random shelf; boxes are named by level and number."""
    pose = _shelf_pose(plan, generator)
    middle = sum(plan.aisle_m) / 2
    ends = (plan.aisle_m[0] - BEYOND_AISLE_M - middle, plan.aisle_m[1] + BEYOND_AISLE_M - middle)
    spacings = generator.uniform(*plan.level_spacing_m, LEVELS - 1)
    levels = generator.uniform(*plan.first_level_m) + np.concatenate([[0.0], np.cumsum(spacings)])
    bodies = [
        _Block(ends, (0.0, SHELF_DEPTH_M), (top - BOARD_THICKNESS_M, top)).body(f"board {level}", "occluder", pose)
        for level, top in enumerate(levels.tolist())
    ]
    top = float(levels[-1]) + plan.level_spacing_m[0]
    bodies += [block.body(f"pole {i}", "occluder", pose) for i, block in enumerate(_poles(plan, ends, top, generator))]
    for level, height in enumerate(levels.tolist()):
        blocks = _boxes_of_a_level(plan, ends, height, generator)
        bodies += [block.body(f"box {level}.{i}", "both", pose) for i, block in enumerate(blocks)]
    return tuple(bodies)


def _shelf_pose(plan: ShelfPlan, generator: np.random.Generator) -> np.ndarray:
    """Pose of the shelf in the world, with its front edge through both ends' jittered distances."""
    start, end = np.array(plan.front_m) + generator.uniform(-plan.front_jitter_m, plan.front_jitter_m, 2)
    turn = -math.atan2(end - start, plan.aisle_m[1] - plan.aisle_m[0])
    cosine, sine = math.cos(turn), math.sin(turn)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return rigid(rotation, (sum(plan.aisle_m) / 2, -(start + end) / 2, 0.0))


def _poles(plan: ShelfPlan, ends: Interval, top: float, generator: np.random.Generator) -> list[_Block]:
    """Uprights before the front edge and behind the rear one, at the ends of all bays."""
    bay = (plan.aisle_m[1] - plan.aisle_m[0]) / plan.bays * generator.uniform(*BAY_STRETCH)
    places = np.arange(ends[0] + generator.uniform(0.0, bay), ends[1] - POLE_M, bay).tolist()
    rows = ((-POLE_M, 0.0), (SHELF_DEPTH_M, SHELF_DEPTH_M + POLE_M))
    return [_Block((place, place + POLE_M), depth, (FLOOR_M, top)) for place in places for depth in rows]


def _boxes_of_a_level(plan: ShelfPlan, ends: Interval, height: float, generator: np.random.Generator) -> list[_Block]:
    """Boxes beside each other from one end to the other, some with an empty place after them or one behind."""
    blocks: list[_Block] = []
    # the first box may extend beyond the end and is then left out: the pattern has a random phase
    cursor = ends[0] - generator.uniform(0.0, plan.box_width_m[1])
    while True:
        along = (cursor, cursor + generator.uniform(*plan.box_width_m))
        if along[1] > ends[1]:
            return blocks
        place = _boxes_at(plan, along, height, generator)
        if along[0] >= ends[0]:
            blocks += place
        empty = generator.uniform() < plan.empty_share
        cursor = along[1] + generator.uniform(*(EMPTY_PLACE_M if empty else NARROW_GAP_M))


def _boxes_at(plan: ShelfPlan, along: Interval, height: float, generator: np.random.Generator) -> list[_Block]:
    """The box in front and, at some places, one behind it."""
    front = generator.uniform(*plan.box_setback_m)
    back = front + generator.uniform(*BOX_DEPTH_M)
    blocks = [_Block(along, (front, back), (height, height + generator.uniform(*plan.box_height_m)))]
    behind, tall = generator.uniform() < plan.second_row_share, generator.uniform(*plan.box_height_m)
    second = back + generator.uniform(*BEHIND_GAP_M)
    deep = generator.uniform(SHALLOWEST_M, max(SHELF_DEPTH_M - second, SHALLOWEST_M))
    if behind:
        blocks.append(_Block(along, (second, second + deep), (height, height + tall)))
    return blocks
