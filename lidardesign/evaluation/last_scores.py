"""The last score of every design of a run, as the run's manifest keeps it for `lidardesign show RUN`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import TypeAdapter, ValidationError

from lidardesign.run.files import sha256_file

if TYPE_CHECKING:
    from lidardesign.evaluation.results import Evaluation

SCORES = "scores"


@dataclass(frozen=True)
class LastScore:
    """The last score of a design, at one number of rays: see `Evaluation.headline_rows`.

    Arguments:
        sha256: Of the design's file as it was scored.
        rays: Rays per frame.
        scenes: The number of held-out scenes.
        value, ci_low, ci_high: The mean score over them, and its 95 % interval.
        detector: The name of the detector.
        settings: Settings of the task other than those that were learned with.
        baseline: The strongest baseline; None where no baseline was scored.
        difference, difference_low, difference_high: The design minus the baseline, scene by scene.
    """

    sha256: str
    rays: int
    scenes: int
    value: float
    ci_low: float | None
    ci_high: float | None
    detector: str
    settings: tuple[str, ...] = ()
    baseline: str | None = None
    difference: float | None = None
    difference_low: float | None = None
    difference_high: float | None = None


def last_scores_of(
    evaluation: Evaluation, paths: Mapping[str, Path], settings: Sequence[str] = ()
) -> dict[str, dict[str, Any]]:
    """The scores of designs, by the names of their files.

    Arguments:
        evaluation: The evaluation.
        paths: The file of each design, by the name that it was scored under.
        settings: Settings of the task other than those that were learned with.
    """
    if evaluation.seeds:  # means over several runs are of none of them
        return {}
    pairs, kept = evaluation.headline_pairs, {}
    for name, row in evaluation.headline_rows.items():
        path, pair = paths.get(name), pairs.get(name)
        if path is None or not path.is_file():
            continue
        ends = () if pair is None else (pair.b, pair.difference, pair.ci_low, pair.ci_high)
        score = LastScore(
            sha256_file(path), row.rays, len(row.per_scene), row.value, row.ci_low, row.ci_high,
            evaluation.detector, tuple(settings), *ends,
        )  # fmt: skip
        kept[path.stem] = asdict(score)
    return kept


def last_score(manifest: Mapping[str, Any], path: Path) -> LastScore | None:
    """The score of a design; None where none is kept, or where the design has changed since."""
    record = (manifest.get(SCORES) or {}).get(path.stem)
    try:
        score = TypeAdapter(LastScore).validate_python(record)
    except ValidationError:
        return None
    return score if score.sha256 == sha256_file(path) else None
