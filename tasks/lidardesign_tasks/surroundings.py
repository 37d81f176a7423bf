"""What a task's scenes are made of and what is around them: surfaces, light, air, speed.

Detectors that count photons meet these; geometry alone does not, and no truth of a scene depends on them. By default
matt grey surfaces rest in clear air and the light of a room.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from lidardesign.scenes.scene import Ambient, Body, Medium, Scene
from lidardesign.space import FARTHEST_M
from lidardesign.task import TaskConfig

# At the visibility one tells 2 % of a contrast: exp(-extinction * visibility) = 0.02 (Koschmieder 1924).
VISIBLE_CONTRAST = 0.02
# Extinction over backscatter of water droplets in near infrared light (O'Connor, Illingworth, Hogan 2004).
DROPLET_LIDAR_RATIO_SR = 18.8
# What bodies reflect that no task gave a reflectance: then nothing needs to be said about them.
MATT_GREY = 0.5
# Poses of so many frames are made in a minute or two, and fill some hundred megabytes.
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
        """The scene in these surroundings; its truth stays.

        Arguments:
            scene: The scene.
            velocity_m_s: At which all its bodies, which rest in all frames, move within one, (3,); None: as they do.
        """
        # what is mirrored is missing from what is matt
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
    """The body with these values; itself where it has them, as bodies check what they are made of."""
    return body if all(getattr(body, name) == value for name, value in values.items()) else replace(body, **values)


class MovingSurroundings(Surroundings):
    """The same of scenes that have `frames`; those of a split are held in memory together."""

    @model_validator(mode="after")
    def _frames_fit(self) -> MovingSurroundings:
        for split in ("train", "test"):
            scenes, frames = getattr(self, split), getattr(self, "frames", 1)
            if scenes * frames > MOST_FRAMES:
                raise ValueError(f"{split}: {scenes} scenes of {frames} frames, allowed: {MOST_FRAMES} frames in all")
        return self


def fog(visibility_m: float) -> Medium:
    """Fog of droplets that are large against the wavelength, so that infrared light fades as visible light does."""
    extinction_per_m = -math.log(VISIBLE_CONTRAST) / visibility_m
    return Medium(extinction_per_m, extinction_per_m / DROPLET_LIDAR_RATIO_SR)


def any_direction(generator: np.random.Generator) -> np.ndarray:
    """A unit vector, even over all directions, shape (3,)."""
    vector = generator.normal(size=3)
    return vector / np.linalg.norm(vector)
