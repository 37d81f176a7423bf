"""Scanning shelves with the warehouse task: rays along the aisle against the baselines, and fits at single positions.

`learn`, `fit` and `evaluate` as whole processes. The claims: a lower miss rate than `uniform` and `random` with at
least 8 times less bandwidth at every number of rays; never above `bounding`, and below it wherever `bounding` misses
more than 2 %; designs at positions between miss no more than at the paper's; a position outside the aisle is refused. A
design at one position is scored on the held-out shelves seen from there.

    python benchmarks/warehouse.py [--run RUN]
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from common import (
    fitted,
    learned,
    lidardesign,
    parser,
    report,
    run_options,
    run_process,
    scored,
    verdict,
    without_traceback,
)

SPARSE = ("uniform", "random")
BASELINES = (*SPARSE, "bounding", "silhouette", "greedy")
ALONG = "benchmark-along"
LEAST_FACTOR = 8.0
BOUNDING_MISSES_PERCENT = 2.0  # below, there is nothing left to be better at
PAPER_M = (0.0, 1.2, 2.4, 3.6)
BETWEEN_M = (0.37, 3.91)
OUTSIDE_M = 4.5


def score_rows(found: dict[str, Any]) -> list[list[object]]:
    """One row per design or baseline and number of rays; bandwidth also as a multiple of the design's."""
    own = {row["rays"]: row["bandwidth_mbps"] for row in found["rows"] if row["design"] not in BASELINES}
    return [
        [
            row["rays"],
            row["design"],
            row["value"],
            f"{row['ci_low']:.1f} to {row['ci_high']:.1f}",
            row["bandwidth_mbps"],
            row["bandwidth_mbps"] / own[row["rays"]],
        ]
        for row in sorted(found["rows"], key=lambda row: row["rays"])
    ]


def verdicts(found: dict[str, Any]) -> list[str]:
    """The claims on baselines."""
    value = {(row["design"], row["rays"]): row["value"] for row in found["rows"]}
    spent = {(row["design"], row["rays"]): row["bandwidth_mbps"] for row in found["rows"]}
    designs = [key for key in value if key[0] not in BASELINES]
    sparse = {
        f"{rays} rays, {baseline}": value[name, rays] < value[baseline, rays]
        and LEAST_FACTOR * spent[name, rays] <= spent[baseline, rays]
        for name, rays in designs
        for baseline in SPARSE
    }
    bounded = {}
    for name, rays in designs:
        theirs = value["bounding", rays]
        must_win = theirs > BOUNDING_MISSES_PERCENT
        bounded[f"{rays} rays"] = value[name, rays] < theirs if must_win else value[name, rays] <= theirs
    return [
        verdict(f"misses less than uniform and random with {LEAST_FACTOR:g} times less bandwidth", sparse),
        verdict(f"never above bounding, below it where it misses over {BOUNDING_MISSES_PERCENT:g} %", bounded),
    ]


def miss_rates(run_folder: Path, designs: list[Any], x_m: float, rays: int) -> dict[str, float]:
    """Mean miss rate [%] on the held-out shelves seen from one position, by design and baseline."""
    from lidardesign import open_run
    from lidardesign.evaluation.request import EvaluationRequest
    from lidardesign.evaluation.score import evaluate
    from lidardesign.task import scenes_of

    run = open_run(run_folder)
    config = run.config
    # the space of one position has no condition left to name
    here = [design.specification.at_condition({"x_m": x_m}) for design in designs]
    space = config.space.at({"x_m": x_m})
    train, test = (scenes_of(run.task, config.task, split, config.seed, space) for split in ("train", "test"))
    request = EvaluationRequest(
        task=run.task,
        config=config.task,
        space=space,
        seed=config.seed,
        designs=here,
        rays=[rays],
        baselines=("uniform", "bounding"),
        equal_bandwidth=False,
        train=train,
        test=test,
    )
    return {row.design: row.value for row in evaluate(request).rows}


def position_row(run: Path, along: Any, x_m: float, rays: int) -> list[object]:
    """One row: the fit at a position, and what it and the others miss there."""
    design = fitted(run, f"benchmark-at-{x_m:g}", at={"x_m": x_m}, rays=rays)
    missed = miss_rates(run, [design, along], x_m, rays)
    figures = [missed[name] for name in (design.name, along.name, "uniform", "bounding")]
    return [x_m, len(design.specification.sensors), design.result.ess, *figures]


def position_verdict(rows: list[list[Any]]) -> str:
    """Whether designs between miss no more than the worst of the paper's positions."""
    most = max(row[3] for row in rows if row[0] in PAPER_M)
    cases = {f"x = {row[0]:g} m": row[3] <= most for row in rows if row[0] not in PAPER_M}
    return verdict("fits between miss no more than at the paper's positions", cases)


def refusal(run: Path) -> str:
    """What `fit` says to a position outside the aisle."""
    result = run_process(lidardesign("fit", run, "--at", f"x_m={OUTSIDE_M:g}", "--name", "benchmark-outside"))
    said = " ".join(result.errors.split())
    return f"x = {OUTSIDE_M:g} m: exit code {result.code}: {said}"


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=1)
    run_options(made)
    made.add_argument("--rays", type=int, nargs="+", default=[6, 12, 18])
    made.add_argument("--fit-rays", type=int, default=12, help="rays of the fits (default %(default)s)")
    made.add_argument("--at", type=float, nargs="*", default=[*PAPER_M, *BETWEEN_M], help="positions [m]")
    options = made.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = learned("warehouse", Path(folder), options, {})
        found, times, fits = scored(run, {ALONG: {}}, options.rays, options.rounds)
        along = fits.get((ALONG, options.fit_rays)) or fitted(run, ALONG, rays=options.fit_rays)
        positions = [position_row(run, along, x_m, options.fit_rays) for x_m in options.at]
        lines = [*verdicts(found), f"fit along the aisle: {along.result.seconds:.1f} s", refusal(run)]
    if set(options.at) & set(PAPER_M) and set(options.at) - set(PAPER_M):
        lines.insert(2, position_verdict(positions))
    missed = f"{found['metric']['name']} {found['metric']['unit']}"
    report(
        "Scanning shelves",
        {
            "evaluate as a whole process": (["rays", "wall s", "CPU s", "peak MiB"], times),
            f"Scores on {found['scenes']} held-out shelves, all positions": (
                ["rays", "design", missed, "95 % interval", "Mbit/s", "of the design's"],
                score_rows(found),
            ),
            f"Fits of {options.fit_rays} rays at one position, and {missed} there": (
                ["x m", "sensors", "ESS", "fit here", "fit along", "uniform", "bounding"],
                positions,
            ),
        },
        lines,
        options.json,
    )


if __name__ == "__main__":
    without_traceback(main)
