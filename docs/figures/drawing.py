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


def save(figure: Figure, path: Path) -> None:
    """As an opaque PNG with colours rounded to a 51st, which halves it: the picture lives in the repository."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    colours = np.asarray(Image.open(buffer).convert("RGB"))
    rounded = COLOUR_STEP * np.round(colours / COLOUR_STEP)
    Image.fromarray(rounded.astype(np.uint8)).save(path, optimize=True)
