"""Tracking with the arm task: 2, 4 and 8 sensors, each at one place or a region, against every baseline, with verdicts.

`learn`, `fit` and `evaluate` as whole processes. The claims: a lower Frechet distance than `uniform` and `random` with
at most half their bandwidth at every number of rays; at the smallest one lower than `bounding` at no more bandwidth.

    python benchmarks/arm.py [--robot iiwa14] [--run RUN]
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from common import REGIONS, learned, parser, report, robot_option, robot_settings, run_options, scored, verdict

FURTHER = ("occupancy", "no-visibility")  # that evaluate only scores when asked
BASELINES = ("uniform", "random", "bounding", "silhouette", "greedy", *FURTHER)
SPARSE = ("uniform", "random")
MOST_OF_THEIR_BANDWIDTH = 0.5


def score_rows(found: dict[str, Any]) -> list[list[object]]:
    """One row per design or baseline and number of rays."""
    spent = bandwidths(found)
    return [
        [
            row["rays"],
            row["design"],
            row["value"],
            f"{row['ci_low']:.3g} to {row['ci_high']:.3g}",
            row["details"].get("tracked_share", float("nan")),
            row["failures"],
            row["bandwidth_mbps"],
            row["bandwidth_mbps"] / spent["uniform", row["rays"]],
        ]
        for row in sorted(found["rows"], key=lambda row: row["rays"])
    ]


def bandwidths(found: dict[str, Any]) -> dict[tuple[str, int], float]:
    """Mbit/s by design or baseline and number of rays."""
    return {(row["design"], row["rays"]): row["bandwidth_mbps"] for row in found["rows"]}


def verdicts(found: dict[str, Any]) -> list[str]:
    """The claims, each over all designs and numbers of rays that it speaks of."""
    value = {(row["design"], row["rays"]): row["value"] for row in found["rows"]}
    spent = bandwidths(found)
    designs = [key for key in value if key[0] not in BASELINES]
    fewest = min(rays for _, rays in value)

    def wins(name: str, rays: int, baseline: str, share: float) -> bool:
        lower = value[name, rays] < value[baseline, rays]
        return lower and spent[name, rays] <= share * spent[baseline, rays]

    sparse = {
        f"{name} with {rays} rays, {baseline}": wins(name, rays, baseline, MOST_OF_THEIR_BANDWIDTH)
        for name, rays in designs
        for baseline in SPARSE
    }
    bounded = {
        f"{name} with {rays} rays": wins(name, rays, "bounding", 1.0) for name, rays in designs if rays == fewest
    }
    return [
        verdict("lower than uniform and random with at most half the bandwidth", sparse),
        verdict(f"lower than bounding with {fewest} rays at no more bandwidth", bounded),
        *(_beside(name, value, spent, designs) for name in FURTHER),
    ]


def _beside(
    baseline: str,
    value: Mapping[tuple[str, int], float],
    spent: Mapping[tuple[str, int], float],
    designs: Sequence[tuple[str, int]],
) -> str:
    """What a baseline that nothing is claimed of comes to, in multiples of the designs at equal rays."""
    worse = [value[baseline, rays] / value[name, rays] for name, rays in designs]
    dearer = [spent[baseline, rays] / spent[name, rays] for name, rays in designs]
    return (
        f"{baseline}: {min(worse):.2f} to {max(worse):.2f} times the distance "
        f"at {min(dearer):.2f} to {max(dearer):.2f} times the bandwidth"
    )


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    robot_option(made)
    run_options(made)
    made.add_argument("--sensors", type=int, nargs="+", default=[2, 4, 8])
    made.add_argument("--rays", type=int, nargs="+", default=[400, 1000, 1200])
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = learned("arm", Path(folder), options, robot_settings(options.robot))
        designs = {
            f"{name}-{sensors}": {"sensors": sensors, "constraints": constraints}
            for sensors in options.sensors
            for name, constraints in {"places": None, "regions": REGIONS}.items()
        }
        found, times, fits = scored(run, designs, options.rays, options.rounds, FURTHER)
    metric = f"{found['metric']['name']} {found['metric']['unit']}"
    columns = ["rays", "design", metric, "95 % interval", "tracked", "failures", "Mbit/s", "of uniform's"]
    report(
        "Tracking with the arm",
        {
            "Fits": (
                ["design", "rays", "s", "log-likelihood", "ESS"],
                [[*key, one.result.seconds, one.result.log_likelihood, one.result.ess] for key, one in fits.items()],
            ),
            "evaluate as a whole process": (["rays", "wall s", "CPU s", "peak MiB"], times),
            f"Scores on {found['scenes']} held-out trajectories": (columns, score_rows(found)),
        },
        verdicts(found),
        options.json,
    )


if __name__ == "__main__":
    main()
