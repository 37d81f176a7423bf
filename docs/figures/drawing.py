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

from lidardesign.scenes.casting import SceneCaster
from lidardesign.scenes.scene import Scene

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
    drawn = Image.open(buffer).convert("RGB")
    if colours is None:
        rounded = COLOUR_STEP * np.round(np.asarray(drawn) / COLOUR_STEP)
        drawn = Image.fromarray(rounded.astype(np.uint8))
    else:
        drawn = drawn.quantize(colours, kmeans=4, dither=Image.Dither.NONE)
    drawn.save(path, optimize=True)


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


class SideOn:
    """A level parallel projection, in which equal lengths stay equal.

    Arguments:
        right: A level direction that is to the right in the picture.
        inside_m: What the picture holds, shape (K, 3) [m].
    """

    def __init__(self, right: np.ndarray, inside_m: np.ndarray) -> None:
        self.axes = np.array([right / np.linalg.norm(right), [0.0, 0.0, 1.0]])
        self.forward = np.cross(self.axes[1], self.axes[0])
        (left, low), (end, high) = self.project(inside_m).min(axis=0), self.project(inside_m).max(axis=0)
        self.window = (left, end, low, high)

    def project(self, points_m: np.ndarray) -> np.ndarray:
        """Where points (..., 3) appear, to the right and up [m], shape (..., 2)."""
        return points_m @ self.axes.T

    def shaded(self, scene: Scene, width: int) -> np.ndarray:
        """The scene in grey light, so many pixels wide, from below, clear where nothing is, shape (H, W, 4)."""
        left, right, low, high = self.window
        height = round(width * (high - low) / (right - left))
        middles = [(np.arange(count) + 0.5) / count for count in (width, height)]
        grid = np.stack(np.meshgrid(left + (right - left) * middles[0], low + (high - low) * middles[1]), axis=-1)
        starts = grid.reshape(-1, 2) @ self.axes - 10.0 * self.forward
        hits = SceneCaster(scene).first_hit(starts, np.broadcast_to(self.forward, starts.shape))
        lamp = np.array([-0.8, 0.9]) @ self.axes - self.forward
        front, lit = np.abs(hits.normal @ self.forward), np.clip(hits.normal @ lamp / np.linalg.norm(lamp), 0.0, 1.0)
        colour = np.outer(0.42 + 0.33 * front + 0.40 * lit, (0.86, 0.81, 0.76, 1.0)).clip(0.0, 1.0)
        colour[:, 3] = np.isfinite(hits.range_m)
        return np.nan_to_num(colour).reshape(height, width, 4)
