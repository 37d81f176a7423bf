"""What users of the task landing may set."""

from __future__ import annotations

from lidardesign import TaskConfig
from pydantic import Field


class LandingConfig(TaskConfig):
    """How many scenes there are, and what stands around the landing place."""

    train: int = Field(100, ge=1, le=10_000, description="training scenes")
    test: int = Field(40, ge=1, le=10_000, description="held-out scenes")
    hazards: int = Field(3, ge=1, le=20, description="boxes around the landing place")
    spread_m: float = Field(1.5, gt=0, le=10, description="standard deviation of their places on the ground [m]")
    height_m: tuple[float, float] = Field((2.0, 6.0), description="lowest and highest place of the drone [m]")
    moving: bool = Field(False, description="whether the boxes drive while the drone looks")
    frames: int = Field(4, ge=2, le=100, description="time frames where they move")
