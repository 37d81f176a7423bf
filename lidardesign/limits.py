"""The limits of what users choose, for messages, help and schemas; importing them loads no library."""

from __future__ import annotations

MAX_SEED = 2**63 - 1
# Returns of so many fill some 100 MB per scene; no scanner fires more in a frame.
MOST_RAYS = 1_000_000
# Responsibilities of so many sensors over all samples fill some 100 MB.
MOST_FITTED = 1000
MOST_PATTERNS = 64  # that follow what they see
# Shares of returns: beyond these an interval holds almost none or almost all of a normal distribution.
LEVELS = (0.01, 0.999999)
DAY_S = 24 * 3600.0
TOLERANCES, TIME_BUDGETS_S = (1e-4, 0.9999), (1.0, 366 * DAY_S)
CMA_SECONDS = (0.1, 7 * DAY_S)
LAW_SECONDS = (0.1, DAY_S)
# A picometre, and further than any sensor reaches.
RANGE_TOLERANCES_MM = (1e-9, 1e9)
RETURN_TOLERANCES = (1e-9, 1.0)
MOST_SCENES, MOST_PORT = 10_000, 65_535
