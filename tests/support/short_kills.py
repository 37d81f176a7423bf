"""A plugin of pytest that shortens `benchmarks/soak/kills.py`: less is learned, and fewer commands are disturbed."""

from __future__ import annotations

from benchmarks.soak import disturbed

LEARN = disturbed.LEARN
LEARN[LEARN.index("learning.steps=160")] = "learning.steps=40"
# it differs from learning without one by where it ends
del disturbed.COMMANDS["learn --tolerance"]
