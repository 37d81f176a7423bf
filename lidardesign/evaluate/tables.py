"""The rows of an evaluation as a CSV table with units in its headers."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from lidardesign.evaluate.results import Evaluation
from lidardesign.run.files import write_atomic


def csv_text(evaluation: Evaluation) -> str:
    """One line per row: equal rays first, then equal bandwidth, which names the design it was matched to."""
    unit = evaluation.metric.unit
    header = (
        "design",
        "rays",
        f"{evaluation.metric.name} [{unit}]",
        f"ci_low [{unit}]",
        f"ci_high [{unit}]",
        "failures",
        "scenes",
        "bandwidth [Mbit/s]",
        "seconds [s]",
        "matched_to",
        "matched_rays",
    )
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    for row in (*evaluation.rows, *evaluation.equal_bandwidth):
        writer.writerow(
            (
                _no_formula(row.design),
                row.rays,
                row.value,
                row.ci_low,
                row.ci_high,
                row.failures,
                evaluation.scenes,
                row.bandwidth_mbps,
                row.seconds,
                _no_formula(row.matched_to or ""),
                "" if row.matched_rays is None else row.matched_rays,
            )
        )
    return buffer.getvalue()


def write_csv(evaluation: Evaluation, path: Path) -> None:
    """Write the rows as UTF-8 CSV, whole or not at all."""
    write_atomic(Path(path), csv_text(evaluation))


def _no_formula(text: str) -> str:
    """A name that spreadsheets would read as a formula is quoted with an apostrophe."""
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text
