"""Settings of the target density and of learning it, with their defaults, units and presets."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from lidardesign.space import FARTHEST_M

Visibility = Literal["auto", "raycast", "quadrature", "off"]
Preset = Literal["draft", "standard", "fine"]
PRESETS: tuple[str, ...] = ("draft", "standard", "fine")
# Between these all squares and products that the density is made of are numbers, in float32 too.
LONGEST_M, SHORTEST_M = FARTHEST_M, 1 / FARTHEST_M
FASTEST_PER_M = 1e12


class DensitySettings(BaseModel):
    """The target density p*(d) (design contract, section 2). `None` means: derived from the others."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    sigma_m: float = Field(
        0.005, ge=SHORTEST_M, le=LONGEST_M, description="standard deviation of the surface proximity [m]"
    )
    visibility: Visibility = Field("auto", description="how occlusion is computed; auto probes whether it is needed")
    attenuation_per_m: float | None = Field(
        None, gt=0, le=FASTEST_PER_M, description="beta [1/m]; default max(1000, 5 / sigma)"
    )
    sharpness_per_m: float | None = Field(
        None, gt=0, le=FASTEST_PER_M, description="k [1/m] of the quadrature; default max(1000, 5 / sigma)"
    )
    margin_m: float | None = Field(None, ge=0, description="m [m]: a surface does not occlude itself; default sigma")
    quadrature_points: int = Field(64, ge=4, le=4096, description="midpoints of the visibility quadrature")
    field_resolution: int = Field(64, ge=8, le=512, description="grid points along the longest side of mesh fields")
    surface_tolerance_nats: float = Field(
        16.0, gt=0, description="scenes whose surface term is this far below the best one skip visibility [nats]"
    )


class LearningSettings(BaseModel):
    """The flow, its optimiser and what is measured after training.

    The largest numbers are what a large computer might bear; what is beyond them is a typing error.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    steps: int = Field(1000, ge=1, le=100_000_000, description="optimiser steps")
    batch: int = Field(1024, ge=2, le=1_000_000, description="design points per step")
    rate: float = Field(1e-2, gt=0, description="initial Adam step size")
    frames: int = Field(
        256, ge=1, le=1_000_000, description="scenes and frames that stand for all in each path-wise step, drawn anew"
    )
    layers: int = Field(3, ge=1, le=32, description="autoregressive spline layers per block of the chain")
    hidden: int = Field(96, ge=4, le=8_192, description="hidden width of each layer's network")
    bins: int = Field(16, ge=2, le=1_024, description="spline bins per dimension")
    dtype: Literal["float64", "float32"] = Field(
        "float32", description="arithmetic of training steps, while it can invert the flow; samples are always float64"
    )
    entropy: float = Field(0.0, ge=0, description="eta of the paper; annealed to 0")
    sigma_start_m: float | None = Field(
        None, ge=SHORTEST_M, le=LONGEST_M, description="where sigma's annealing starts; default 6 sigma"
    )
    anneal: float = Field(0.7, ge=0, le=1, description="share of the path-wise steps over which sigma falls")
    balance: float = Field(0.5, ge=0, le=1, description="share of the steps, the last ones, that balance by values")
    balance_proposals: int = Field(
        65536, ge=256, le=10_000_000, description="independent proposals that balancing draws from"
    )
    clip_norm: float = Field(5.0, gt=0, description="gradient norm that steps are clipped to")
    checkpoint_seconds: float = Field(20.0, gt=0, description="time between checkpoints [s]")
    samples: int = Field(
        100_000, ge=1000, le=10_000_000, description="fresh samples for ESS, KL, log Z, fit and constrain"
    )
    coverage_proposals: int = Field(
        8192, ge=256, le=10_000_000, description="independent proposals that coverage is measured on"
    )


PRESET_LEARNING: dict[str, dict[str, Any]] = {
    "draft": {
        "steps": 350,
        "hidden": 64,
        "samples": 40_000,
        "balance_proposals": 32768,
        "coverage_proposals": 4096,
    },
    "standard": {},
    "fine": {"steps": 2400, "batch": 4096, "layers": 4, "hidden": 128, "bins": 24, "samples": 200_000},
}
