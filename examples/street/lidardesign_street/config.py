"""What users of the task street may set."""

from __future__ import annotations

from lidardesign import TaskConfig
from pydantic import Field

Point = tuple[float, float, float]


class StreetConfig(TaskConfig):
    """How many scenes there are, how busy the street is, and where on the roof sensors may stand."""

    train: int = Field(100, ge=1, le=10_000, description="training scenes")
    test: int = Field(60, ge=1, le=10_000, description="held-out scenes")
    users: int = Field(5, ge=1, le=10, description="road users in each band of 20 m around the car, of three")
    origin_box_m: tuple[Point, Point] = Field(
        ((-1.0, -0.7, 1.65), (0.8, 0.7, 2.1)),
        description="lowest and highest corner of where sensors may be; the car's roof ends at 1.56 m, x is ahead [m]",
    )
