"""Surroundings of a task's scenes: reflectance of surfaces, ambient light, air and velocity.

They affect only detectors that count photons, not geometry or the truth of a scene. By default surfaces are matt grey
and at rest, in clear air and indoor light.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from lidardesign import FARTHEST_M, Ambient, Body, Medium, Scene, TaskConfig

# Contrast at the visibility, which defines it: exp(-extinction * visibility) = 0.02 (Koschmieder 1924).
VISIBLE_CONTRAST = 0.02
# Extinction over backscatter of water droplets in near infrared light (O'Connor, Illingworth, Hogan 2004).
DROPLET_LIDAR_RATIO_SR = 18.8
# Default reflectance of bodies.
MATT_GREY = 0.5
# Poses of so many frames take a minute or two, and some hundred megabytes.
MOST_FRAMES = 200_000


class Surroundings(TaskConfig):
    """Surfaces, light and air, the same in all scenes of a task."""

    illuminance_lux: float = Field(
        300.0, ge=0, le=200_000, description="light on the surfaces [lux]; sunlight is 100,000"
    )
    light: Literal["indoor", "sun"] = Field("indoor", description="its spectrum: white LEDs, or the sun")
    visibility_m: float | None = Field(
        None, ge=0.01, le=FARTHEST_M, description="visibility in fog [m]; empty: clear air"
    )
    reflectance: float = Field(MATT_GREY, ge=0, le=1, description="share of the light that surfaces reflect diffusely")
    gloss: float = Field(0.0, ge=0, le=1, description="share of the light that surfaces mirror instead")

    def around(self, scene: Scene, velocity_m_s: Any = None) -> Scene:
        """The scene in these surroundings, with the same truth.

        Arguments:
            scene: The scene.
            velocity_m_s: Velocity of all its bodies within a frame, (3,); None: unchanged.
        """
        # the mirrored share is missing from the diffuse one
        changed: dict[str, Any] = {"reflectance": (1 - self.gloss) * self.reflectance, "specular": self.gloss}
        if velocity_m_s is not None:
            changed["velocity_m_s"] = tuple(map(float, velocity_m_s))
        return replace(
            scene,
            bodies=tuple(_changed(body, changed) for body in scene.bodies),
            ambient=Ambient(self.illuminance_lux, self.light) if self.illuminance_lux else None,
            medium=None if self.visibility_m is None else fog(self.visibility_m),
        )


def _changed(body: Body, values: dict[str, Any]) -> Body:
    """The body with these values, or itself if unchanged, which saves the checks of a new one."""
    return body if all(getattr(body, name) == value for name, value in values.items()) else replace(body, **values)


class MovingSurroundings(Surroundings):
    """Surroundings of scenes with `frames`, with a limit of the frames of a split, which are in memory together."""

    @model_validator(mode="after")
    def _frames_fit(self) -> MovingSurroundings:
        for split in ("train", "test"):
            scenes, frames = getattr(self, split), getattr(self, "frames", 1)
            if scenes * frames > MOST_FRAMES:
                raise ValueError(f"{split}: {scenes} scenes of {frames} frames, allowed: {MOST_FRAMES} frames in all")
        return self


def fog(visibility_m: float) -> Medium:
    """Fog of droplets larger than the wavelength, so that extinction in the infrared is as in visible light."""
    extinction_per_m = -math.log(VISIBLE_CONTRAST) / visibility_m
    return Medium(extinction_per_m, extinction_per_m / DROPLET_LIDAR_RATIO_SR)


def any_direction(generator: np.random.Generator) -> np.ndarray:
    """A random unit vector, uniform over all directions, shape (3,)."""
    vector = generator.normal(size=3)
    return vector / np.linalg.norm(vector)
