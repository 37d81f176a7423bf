"""The headline of an evaluation, and the thresholds of designs: no worse than a limit, better than a baseline, unmoved.

Each check raises a `ThresholdError`, with which commands exit 1.
"""

from __future__ import annotations

from dataclasses import replace

from lidardesign.errors import ThresholdError
from lidardesign.estimates import comparison
from lidardesign.evaluation.results import BY_HAND, Evaluation, Paired, verdict


def difference_text(pair: Paired, better: str, unit: str) -> str:
    """A difference as a sentence, for the metric's direction and unit."""
    rays = f"at {pair.rays} rays" if pair.rays_b in (None, pair.rays) else f"at {pair.rays} and {pair.rays_b} rays"
    return f"{pair.a} is {comparison(pair.interval, pair.b, better, unit)} {rays}"


def headline_texts(evaluation: Evaluation) -> list[str]:
    """The best design against what one would place by hand, then against the strongest baseline; all against that one.

    Empty without baselines.
    """
    rows, metric, strongest = evaluation.headline_rows, evaluation.metric, evaluation.strongest_baseline
    if strongest is None or not evaluation.headline_pairs:
        return []
    best = evaluation.best_row
    pairs = {pair.b: pair for pair in evaluation.paired if (pair.a, pair.rays) == (best.design, best.rays)}
    by_hand = [pairs[name] for name in BY_HAND if name in pairs]
    plain = [comparison(pair.interval, pair.b, metric.better, metric.unit) for pair in by_hand]
    name = best.design if len(rows) == 1 else f"{best.design}, the best design,"
    said = [f"{name} is {' and '.join(plain)} at {best.rays} rays"] if plain else []
    if strongest.name not in BY_HAND and strongest.name in pairs:
        its = next(row for row in evaluation.rows if (row.design, row.rays) == (strongest.name, best.rays))
        may = "with no more gates"
        if its.gates > best.gates:
            may = f"any rays, with {its.gates} gates for the {best.gates} of {best.design}"
        against = comparison(pairs[strongest.name].interval, strongest.name, metric.better, metric.unit)
        said.append(
            f"The strongest baseline on training scenes is {strongest.name} ({may}): {best.design} is {against}"
        )
    if len(rows) > 1:
        said.append(f"Against {strongest.name}: {_verdicts(evaluation)}")
    return said


def _verdicts(evaluation: Evaluation) -> str:
    """Which designs are better and worse than the strongest baseline, and which neither."""
    pairs, parts = list(evaluation.headline_pairs.values()), []
    for word in ("better", "worse", "open"):
        names = [pair.a for pair in pairs if verdict(evaluation, pair) == word]
        listed = " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))
        verb = "are" if len(names) > 1 else "is"
        parts += [f"{listed}: no significant difference" if word == "open" else f"{listed} {verb} {word}"] * bool(names)
    return "; ".join(parts)


def check_limit(evaluation: Evaluation, limit: float) -> None:
    """Refuse designs that are worse than a limit in the metric's unit; baselines never count.

    Where lower is better, a row misses the limit by lying above it; where higher is better, by lying below
    it: `--fail-above` then reads as "fail where worse than". A value equal to the limit meets it.

    Raises:
        ThresholdError: One is, at one of the numbers of rays.
    """
    unit, is_lower = evaluation.metric.unit, evaluation.metric.better == "lower"
    rows = [row for row in evaluation.rows if not row.baseline]
    missed = [row for row in rows if (row.value > limit if is_lower else row.value < limit)]
    if missed:
        bound = "at most" if is_lower else "at least"
        rows = ", ".join(f"{row.design} at {row.rays} rays: {row.value:.4g} {unit}" for row in missed)
        raise ThresholdError(rows, where="--fail-above", allowed=f"{bound} {limit:g} {unit}")


def check_better(evaluation: Evaluation, name: str) -> None:
    """Refuse designs that are not better than a baseline or another design, by the interval of the difference.

    Arguments:
        evaluation: The scores.
        name: Of the baseline or design.

    Raises:
        ThresholdError: One is worse at one of its numbers of rays, no difference was found, or there is nothing to
            compare it with.
    """
    turned = {(pair.b, pair.rays): _turned(pair) for pair in evaluation.paired if pair.a == name}
    pairs = turned | {(pair.a, pair.rays): pair for pair in evaluation.paired if pair.b == name}
    rows = [row for row in evaluation.rows if not row.baseline and row.design != name]
    held = [(row, pairs.get((row.design, row.rays))) for row in rows]
    missed = [(row, pair) for row, pair in held if pair is None or verdict(evaluation, pair) != "better"]
    if not missed:
        return
    metric = evaluation.metric
    said = [
        f"{name} has no score at {row.rays} rays to compare {row.design} with"
        if pair is None
        else difference_text(pair, metric.better, metric.unit)
        for row, pair in missed
    ]
    is_open = any(pair is not None and verdict(evaluation, pair) == "open" for _, pair in missed)
    raise ThresholdError(
        "; ".join(said),
        where="--fail-unless-better",
        allowed=f"better than {name} at every number of rays",
        hint="score more held-out scenes to resolve smaller differences" if is_open else None,
    )


def _turned(pair: Paired) -> Paired:
    ends = (None, None) if pair.ci_low is None or pair.ci_high is None else (-pair.ci_high, -pair.ci_low)
    return replace(pair, a=pair.b, b=pair.a, difference=-pair.difference, ci_low=ends[0], ci_high=ends[1], percent=None)


def check_audit(evaluation: Evaluation) -> None:
    """Refuse an audit in which skipped effects change a row by more than the metric's tolerance.

    Raises:
        ThresholdError: They do.
    """
    audit = evaluation.audit
    if audit is not None and audit.failed:
        rows = ", ".join(
            f"{row.planned.design} at {row.planned.rays} rays by {abs(row.difference):.4g}" for row in audit.failed
        )
        there = {effect.name for effect in evaluation.effects if effect.range_m or effect.lost}
        raise ThresholdError(
            f"skipped effects move {rows} {audit.unit}",
            where="--effects audit",
            allowed=f"at most {audit.tolerance:g} {audit.unit}, the metric's tolerance",
            hint="--effects all, or a smaller --range-tolerance-mm or --return-tolerance; skipped: "
            + ", ".join(name for name in audit.skipped if name in there),
        )
