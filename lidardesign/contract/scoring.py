"""Laws of a task's targets, which are in reach, and of its score, which depends on returns alone."""

from __future__ import annotations

import numpy as np

from lidardesign.contract.law import (
    BrokenLawError,
    Law,
    LawHolds,
    NotApplicable,
    Subject,
    full_rays,
    returns_of_rays,
    shuffled,
    without_returns,
)
from lidardesign.numerics import ROUNDING, SLACK
from lidardesign.rays.information import checked_information, features_of, informs_rays
from lidardesign.run.content import fingerprint
from lidardesign.scenes.rays import Returns
from lidardesign.scenes.scene import Scene
from lidardesign.task import Information, prepares

DENSE, SPARSE = 400, 12
SEED = 20_253
# Of the metric's tolerance: what another order of the same additions may change.
ORDER_SHARE = 0.01
COPIES = "work on copies: the next design is scored there too"


def _dense(subject: Subject, number: int) -> list[Returns]:
    return subject.returns(number, subject.rays(number, DENSE))


def _worse(subject: Subject, value: float, than: float) -> float:
    """The amount by which a value is worse than another, in the metric's unit; negative where it is better."""
    return value - than if subject.metric.better == "lower" else than - value


def check_reach(subject: Subject) -> LawHolds:
    """Rays of the design space meet targets in every checked scene."""
    counts = [sum(map(len, subject.rays(number, DENSE))) for number in range(len(subject.looked_at))]
    if not min(counts):
        raise BrokenLawError(
            f"no ray from the design space meets a target of scene {subject.looked_at[counts.index(0)].name!r}",
            hint="widen the angles or the range, move the origin, or check the units: all lengths are metres",
        )
    return LawHolds(f"{sum(counts)} rays meet targets in {len(counts)} scenes", {"rays": sum(counts)})


def check_number(subject: Subject) -> LawHolds:
    """Returns of dense, of sparse and of random rays are scored by a finite number or fail."""
    values = []
    for number, scene in enumerate(subject.looked_at):
        space, generator = subject.config.space, np.random.default_rng([SEED, number])
        anywhere = [full_rays(space.at(one).sample(DENSE, generator), space) for one in subject.conditions]
        for lists in (subject.rays(number, DENSE), subject.rays(number, SPARSE), anywhere):
            values.append(subject.score(scene, subject.returns(number, lists)).value)
    return LawHolds(
        f"{len(values)} scores from {min(values):.4g} to {max(values):.4g} {subject.metric.unit}",
        {"least": min(values), "most": max(values)},
    )


def check_nothing(subject: Subject) -> LawHolds:
    """No rays and rays without returns are scored, and no better than returns."""
    found = []
    for number, scene in enumerate(subject.looked_at):
        none = [rays.subset(np.zeros(0, dtype=int)) for rays in subject.rays(number, SPARSE)]
        silent = without_returns(_dense(subject, number))
        dense = subject.score(scene, _dense(subject, number))
        for what, returns in (("no rays", subject.returns(number, none)), ("rays without a return", silent)):
            score = subject.score(scene, returns)
            if _worse(subject, dense.value, score.value) > subject.metric.tolerance:
                raise BrokenLawError(
                    f"scene {scene.name!r}: {what} score {score.value:.4g}, better than {dense.value:.4g} of "
                    f"{DENSE} returns from targets",
                    hint="where there are too few returns to compute anything, return Score(metric.worst, failed=True)",
                )
            found.append(score.failed)
    return LawHolds(
        "counts as failed" if all(found) else "scored as a number" if not any(found) else "failed or a number",
        {"failed": float(np.mean(found))},
    )


def check_best(subject: Subject) -> LawHolds:
    """Many exact returns from targets score at least as well as few, and better than none."""
    scores = []
    for number, scene in enumerate(subject.looked_at):
        dense, sparse = _dense(subject, number), subject.returns(number, subject.rays(number, SPARSE))
        scores.append([subject.score(scene, one).value for one in (dense, sparse, without_returns(dense))])
    best, few, nothing = np.mean(scores, axis=0).tolist()
    metric = subject.metric
    said = f"{best:.4g} of {DENSE} rays at targets, {few:.4g} of {SPARSE}, {nothing:.4g} of none [{metric.unit}]"
    if _worse(subject, best, few) > metric.tolerance or not _worse(subject, nothing, best) > 0:
        raise BrokenLawError(
            f"the score does not reward seeing the targets: {said}",
            allowed=f"the first is the best ({metric.better} is better)",
            hint="check metric.better and what score() compares",
        )
    return LawHolds(said, {"dense": best, "sparse": few, "none": nothing})


def check_order(subject: Subject) -> LawHolds | NotApplicable:
    """The order in which rays are listed does not matter."""
    if prepares(subject.task):
        return NotApplicable("the task prepares for rays in their order")
    worst = 0.0
    for number, scene in enumerate(subject.looked_at):
        returns = _dense(subject, number)
        value = subject.score(scene, returns).value
        other = subject.score(scene, shuffled(returns, np.random.default_rng([SEED, number]))).value
        worst = max(worst, abs(other - value))
    limit = ORDER_SHARE * subject.metric.tolerance
    if worst > limit:
        raise BrokenLawError(
            f"rays in another order change the score by {worst:.3g} {subject.metric.unit}", allowed=f"{limit:.3g}"
        )
    return LawHolds(f"changes by at most {worst:.1g} {subject.metric.unit}", {"difference": worst})


def check_repeats(subject: Subject) -> LawHolds:
    """The same returns have the same score every time, to the bit."""
    for number, scene in enumerate(subject.looked_at):
        returns = _dense(subject, number)
        first, again = subject.score(scene, returns), subject.score(scene, returns)
        if fingerprint(first) != fingerprint(again):
            raise BrokenLawError(f"scene {scene.name!r}: {first.value!r}, then {again.value!r} for the same returns")
    return LawHolds("scored twice, bit for bit the same")


def check_untouched(subject: Subject) -> LawHolds:
    """Scoring changes neither the scene nor the returns."""
    for number, scene in enumerate(subject.looked_at):
        returns = _dense(subject, number)
        heard = fingerprint(returns)
        subject.score(scene, returns)
        if fingerprint(returns) != heard:
            raise BrokenLawError(f"score changed returns in scene {scene.name!r}", hint=COPIES)
    touched = subject.touched()
    if touched:
        raise BrokenLawError(f"score changed the scene {touched[0]!r}", hint=COPIES)
    return LawHolds(f"{len(subject.looked_at)} scenes and their returns are as they were")


def check_prepared(subject: Subject) -> LawHolds | NotApplicable:
    """What is prepared anew, and was not scored by yet, gives the same scores; the scenes are as they were."""
    if not prepares(subject.task):
        return NotApplicable("the task has no method prepare")
    again, worst, limit = subject.new_preparation(), 0.0, ORDER_SHARE * subject.metric.tolerance
    for number, scene in enumerate(subject.looked_at):
        returns = subject.returns(number, subject.rays(0, DENSE))
        first, other = (subject.score(scene, returns, one) for one in (subject.preparation, again))
        worst = max(worst, abs(other.value - first.value))
    if worst > limit:
        raise BrokenLawError(
            f"preparing again changes the score by {worst:.3g} {subject.metric.unit}",
            allowed=f"{limit:.3g}",
            hint="draw random numbers from `seed`, keep nothing between calls, and change no `prepared` in score()",
        )
    if subject.touched():
        raise BrokenLawError(f"prepare changed the scene {subject.touched()[0]!r}", hint=COPIES)
    return LawHolds(f"changes by at most {worst:.1g} {subject.metric.unit}", {"difference": worst})


def check_information(subject: Subject) -> LawHolds | NotApplicable:
    """Information depends on a ray's own returns alone: one pair per item and frame, in any order of rays."""
    if not informs_rays(subject.task):
        return NotApplicable("the task has no method informs, so rays of its designs cannot be chosen")
    pairs, rays = 0, 0
    for number, scene in enumerate(subject.looked_at):
        dense = _dense(subject, number)
        # one list of candidates is fired everywhere, also where fewer rays see something
        order = np.random.default_rng([SEED, number]).permutation(min(len(one.rays) for one in dense))
        first, other = ([returns_of_rays(one, chosen) for one in dense] for chosen in (np.sort(order), order))
        with subject.calling("informs"):
            found, reordered, silent = (
                checked_information(subject.task, scene, returns) for returns in (first, other, without_returns(first))
            )
        said = f"informs in scene {scene.name!r}"
        if len(silent.ray) or (silent.harm is not None and np.any(silent.harm)):
            raise BrokenLawError(f"{said}: rays without a return have worth or harm")
        if not np.stack([one.returned for one in first])[found.source, found.ray].all():
            raise BrokenLawError(f"{said}: a ray has worth from a frame in which it has no return")
        one, two = _pairs(found, np.sort(order)), _pairs(reordered, order)
        if len(np.unique(one[:, :3], axis=0)) < len(one):
            raise BrokenLawError(f"{said}: a pair of an item and a ray is given twice")
        if one.shape != two.shape or not np.allclose(one, two, rtol=SLACK, atol=0):
            raise BrokenLawError(f"{said}: the worth of rays changes with their order")
        pairs, rays = pairs + len(one), rays + len(order)
        _check_features(subject, scene, first, other)
    if not rays:
        return NotApplicable("no candidate rays see a target under every condition")
    if not pairs:
        raise BrokenLawError(f"informs: {rays} rays at targets are worth nothing")
    return LawHolds(f"{rays} rays and their items are {pairs} pairs", {"pairs": pairs})


def _check_features(subject: Subject, scene: Scene, first: list[Returns], other: list[Returns]) -> None:
    """Features of a frame, where a task gives any, are as many in any order of rays, and none of them without returns.

    Raises:
        BrokenLawError: They are not.
    """
    features, said = features_of(subject.task), f"features in scene {scene.name!r}"
    if features is None:
        return
    for one, reordered, silent in zip(first, other, without_returns(first), strict=True):
        with subject.calling("features"):
            found, again, nothing = (features(scene, returns) for returns in (one, reordered, silent))
        if not (len(found) == len(again) == len(nothing)):
            raise BrokenLawError(f"{said}: {len(found)}, {len(again)} and {len(nothing)} of them")
        if not np.allclose(found, again, rtol=ROUNDING, atol=ROUNDING, equal_nan=True):
            raise BrokenLawError(f"{said}: other numbers with rays in another order")
        if np.isfinite(nothing).all():
            raise BrokenLawError(f"{said}: numbers without a return", hint="not a number where nothing is known")


def _pairs(found: Information, rays: np.ndarray) -> np.ndarray:
    """Item, ray, frame and worth of all pairs, sorted, (E, 4), with rays numbered by `rays` (N,)."""
    columns = [found.item, rays[found.ray], found.source, found.worth]
    return np.column_stack(columns)[np.lexsort(columns[2::-1])]


LAWS = (
    Law(
        "targets are in reach",
        "scenes",
        "rays of the design space meet targets",
        check_reach,
        needs=("scenes are made", "conditions lie in the space"),
    ),
    Law(
        "scores are numbers",
        "score",
        "a finite number, or failed, for dense, sparse and random rays",
        check_number,
        needs=("metric is defined", "targets are in reach"),
    ),
    Law(
        "no returns are scored",
        "score",
        "no rays and no returns are scored, no better than returns",
        check_nothing,
        needs=("scores are numbers",),
    ),
    Law(
        "best on the truth",
        "score",
        "many exact returns score best, none worst",
        check_best,
        needs=("scores are numbers",),
    ),
    Law(
        "order does not matter",
        "score",
        "rays in another order have the same score",
        check_order,
        needs=("scores are numbers",),
    ),
    Law("scores repeat", "score", "the same returns have the same score", check_repeats, needs=("scores are numbers",)),
    Law(
        "scores change nothing",
        "score",
        "scenes and returns are as they were after scoring",
        check_untouched,
        needs=("scores are numbers",),
    ),
    Law(
        "preparing repeats",
        "score",
        "preparing again gives the same scores, and changes no scene",
        check_prepared,
        needs=("scores are numbers",),
    ),
    Law(
        "returns inform",
        "score",
        "rays tell about items by their own returns alone, in any order",
        check_information,
        needs=("scores are numbers",),
    ),
)
