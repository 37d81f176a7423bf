"""Seeds of the small runs that tests learn. No test may hang on the luck of one: SMALL_RUN_SEED_SHIFT shifts them all.

How well a small run goes differs as much between two kinds of processor as between two seeds.
"""

from __future__ import annotations

import os
from pathlib import Path

SHIFT = int(os.environ.get("SMALL_RUN_SEED_SHIFT", "0"))


def shifted(seed: int = 0) -> int:
    """The seed of a small run."""
    return seed + SHIFT


def shifting_environment() -> dict[str, str]:
    """The environment of a script that starts `lidardesign learn` by itself."""
    if not SHIFT:
        return dict(os.environ)
    paths = [str(Path(__file__).parent / "shifted_seeds"), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
