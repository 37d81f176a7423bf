"""What the scripts of this folder share: results of `lidardesign` commands, colours, and small PNG files."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

INK, QUIET, PAPER = "#1f2933", "#7b8794", "#ffffff"
COLOUR_STEP = 5  # of 255: divides it, so that white stays white


def command(*words: str | Path) -> dict[str, Any]:
    """The JSON document of a `lidardesign` command."""
    program = "import sys; from lidardesign.cli.main import run; sys.exit(run())"
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, words), "--json", "--quiet"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"lidardesign {words[0]} failed: {done.stderr or done.stdout}")
    return json.loads(done.stdout)


def save(figure: Figure, path: Path, colours: int | None = None) -> None:
    """As an opaque PNG with colours rounded to a 51st, or with so few, which halves it: it lives in the repository."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    if colours is None:
        _save_rounded(Image.open(buffer), path)
    else:
        few = Image.open(buffer).convert("RGB").quantize(colours, kmeans=4, dither=Image.Dither.NONE)
        few.save(path, optimize=True)


def _save_rounded(drawn: Image.Image, path: Path) -> None:
    rounded = COLOUR_STEP * np.round(np.asarray(drawn.convert("RGB")) / COLOUR_STEP)
    Image.fromarray(rounded.astype(np.uint8)).save(path, optimize=True)


class Camera:
    """A pinhole camera.

    Arguments:
        eye_m: Where it is [m].
        aim_m: What it looks at [m].
        pixels: Of the picture, across and down.
        half_width: Tangent of half the horizontal angle of view.
    """

    def __init__(self, eye_m: np.ndarray, aim_m: np.ndarray, pixels: tuple[int, int], half_width: float) -> None:
        self.eye_m, self.pixels = eye_m, pixels
        self.scale = pixels[0] / (2 * half_width)  # pixels per tangent
        forward = aim_m - eye_m
        self.forward = forward / np.linalg.norm(forward)
        right = np.cross(self.forward, [0.0, 0.0, 1.0])
        self.right = right / np.linalg.norm(right)
        self.up = np.cross(self.right, self.forward)

    def directions(self) -> np.ndarray:
        """Unit vectors through all pixels, row by row from above, shape (N, 3)."""
        across, down = np.meshgrid(*(np.arange(count) + 0.5 for count in self.pixels))
        right, up = (across - self.pixels[0] / 2), (self.pixels[1] / 2 - down)
        rays = self.forward + (right[..., None] * self.right + up[..., None] * self.up) / self.scale
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Where points (..., 3) appear, in pixels from the upper left, shape (..., 2)."""
        away = points_m - self.eye_m
        scale = self.scale / (away @ self.forward)
        right, up = scale * (away @ self.right), scale * (away @ self.up)
        return np.stack([self.pixels[0] / 2 + right, self.pixels[1] / 2 - up], -1)
