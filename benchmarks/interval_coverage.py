"""How often 95 % intervals hold the truth: simulated scores of two designs in 10, 20 and 50 groups of scenes.

A usual score is the difficulty of a group, which both designs share, times what is drawn for each design in a group and
in a scene; where a design fails, its score is the worst value, ten times a usual one. Intervals are those of
`evaluate`: of a design's mean, of the paired difference, and of the ratio.

    python benchmarks/interval_coverage.py
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from common import parser, report, verdict

WORST = 10.0
RATIO = 1.3  # of the second design's usual scores to those of the first
GROUPS = (10, 20, 50)
SIZES: Mapping[str, Sequence[int]] = {"of 4": (4,), "of 2 to 6": (2, 3, 4, 5, 6)}
LEAST = 0.92


class Scores(NamedTuple):
    """How one design's scores are drawn.

    Arguments:
        name: For tables.
        usual: Name and parameters of the distribution over groups, whose mean is 1, of numpy's generator.
        failing: The share of failures.
        together: Whether whole groups fail.
    """

    name: str
    usual: tuple[Any, ...]
    failing: float = 0.0
    together: bool = False


NORMAL = Scores("normal", ("normal", 1.0, 0.3))
GAMMA = Scores("gamma", ("gamma", 2.0, 0.5))
LOGNORMAL = Scores("lognormal", ("lognormal", -0.125, 0.5))
HEAVY = Scores("heavy", ("lognormal", -0.5, 1.0))
PAIRS = (
    (NORMAL, NORMAL),
    (GAMMA, GAMMA),
    (LOGNORMAL, GAMMA),
    (HEAVY, HEAVY),
    (HEAVY, LOGNORMAL),
    (GAMMA._replace(name="10 % of scenes fail", failing=0.1), GAMMA),
    (GAMMA._replace(name="10 %", failing=0.1), GAMMA._replace(name="30 % of scenes fail", failing=0.3)),
    (GAMMA._replace(name="20 % of groups fail", failing=0.2, together=True), GAMMA),
    (GAMMA._replace(name="40 % of groups fail", failing=0.4, together=True), GAMMA),
)


def held(first: Scores, second: Scores, counts: Any, trials: int, generator: Any) -> list[float]:
    """The shares of intervals of the first mean, of the difference and of the ratio that hold the truth."""
    import numpy as np

    from lidardesign.estimates import mean_interval, paired_difference, relative_difference

    group = np.repeat(np.arange(len(counts)), counts)

    def drawn(scores: Scores, usual: Any) -> Any:
        name, *parameters = scores.usual
        of_groups = getattr(generator, name)(*parameters, len(counts))
        usual = usual * of_groups[group] * generator.gamma(8, 1 / 8, len(group))
        chance = generator.random(len(counts))[group] if scores.together else generator.random(len(group))
        return np.where(chance < scores.failing, WORST, usual)

    means = [one.failing * WORST + (1 - one.failing) * usual for one, usual in ((first, 1.0), (second, RATIO))]
    truths, found = (means[0], means[0] - means[1], 100 * (means[0] / means[1] - 1)), np.zeros(3)
    for _ in range(trials):
        difficulty = generator.gamma(16, 1 / 16, len(counts))[group]
        own, other = drawn(first, difficulty), drawn(second, RATIO * difficulty)
        intervals = (
            mean_interval(own, group),
            paired_difference(own, other, group),
            relative_difference(own, other, group),
        )
        found += [one.low <= truth <= one.high for one, truth in zip(intervals, truths, strict=True)]
    return list(found / trials)


def main() -> None:
    """Simulate and print."""
    import numpy as np

    options_of = parser(__doc__)
    options_of.add_argument("--trials", type=int, default=2000, help="comparisons of each kind (default %(default)s)")
    options = options_of.parse_args()
    kinds = ("mean", "difference", "ratio")
    columns = [f"{kind}, {groups}" for kind in kinds for groups in GROUPS]
    rows, enough, generator = [], {}, np.random.default_rng(0)
    for size, sizes in SIZES.items():
        for first, second in PAIRS:
            name, counts = f"{first.name}, {second.name}", [np.tile(sizes, count // len(sizes)) for count in GROUPS]
            shares = np.array([held(first, second, one, options.trials, generator) for one in counts]).T
            rows.append([size, name, *(f"{share:.3f}" for share in shares.flat)])
            enough |= {
                f"{name}, {size}: {kind}": bool(of_kind.min() >= LEAST)
                for kind, of_kind in zip(kinds, shares, strict=True)
            }
    report(
        "Coverage of intervals",
        {f"Share of {options.trials} 95 % intervals that hold the truth": (["groups", "scores", *columns], rows)},
        [verdict(f"at least {LEAST}, however many groups", enough)],
        options.json,
    )


if __name__ == "__main__":
    main()
