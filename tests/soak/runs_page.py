"""The page of the random runs: what they covered and how they ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from support.result_pages import heading, paragraph, table, write_page

from soak.whole_runs import BLIND, DONE, INFEASIBLE, ROUGH, USAGE, WHOLE


def runs_page(path: Path, records: Sequence[dict[str, Any]], command: str) -> None:
    """Write the page."""
    faults = [f"- seed {r['seed']}: {fault}" for r in records for fault in r["faults"]]
    parts = [
        heading("Random whole runs", command),
        paragraph(_summary(records)),
        paragraph(_missing(records)),
        table(("how it ended", "runs"), _outcomes(records)),
        table(
            ("constraints", "asked", "kept", "refused with exit 4", "too few samples left, exit 2"),
            _constraints(records),
        ),
        "## Faults\n\n" + ("\n".join(faults) if faults else "None."),
        paragraph("`python -m soak one SEED` does a run again and shows its configuration."),
    ]
    write_page(path, parts)


def _summary(records: Sequence[dict[str, Any]]) -> str:
    whole = [r for r in records if r["outcome"] == WHOLE]

    def span(key: str) -> str:
        values = [r[key] for r in whole]
        return f"{min(values):.2g} to {max(values):.2g}" if values else "none"

    repeated = [r["repeated"] for r in records if r["repeated"] is not None]
    return (
        f"{len(whole)} runs did all of learn, fit, constrain and evaluate: widths of {span('size_m')} m, sigma of "
        f"{span('sigma_share')} of the width, {span('free')} free dimensions, {span('sensors')} sensors. "
        f"{sum(r['bounds'] for r in records)} bounds were read back from the written files and checked. "
        f"{sum(repeated)} of {len(repeated)} runs that were done twice repeated every document and every byte of "
        "densities, samples and designs."
    )


def _missing(records: Sequence[dict[str, Any]]) -> str:
    """Runs between others that were not done when the page was made; empty where there are none."""
    done = {record["seed"] for record in records}
    missing = [str(seed) for seed in range(min(done, default=0), max(done, default=0)) if seed not in done]
    return f"Not done when this was written: seeds {', '.join(missing)}." if missing else ""


def _outcomes(records: Sequence[dict[str, Any]]) -> list[tuple[str, int]]:
    counts = Counter(r["outcome"] for r in records)
    meaning = {
        WHOLE: "learned, fitted, constrained, evaluated",
        ROUGH: "learned; `fit` refuses the density as too rough (exit 3, or 4 for so many sensors)",
        BLIND: "`learn` says that the design space sees no target (exit 3)",
        "fault": "a fault",
    }
    return [(text, counts[outcome]) for outcome, text in meaning.items()]


def _constraints(records: Sequence[dict[str, Any]]) -> list[tuple[object, ...]]:
    kinds: dict[str, Counter[int]] = {}
    for record in records:
        for command, asked, code, _ in record["steps"]:
            if command == "constrain":
                kind = {"kept already": "bounds that the fit kept already", "drawn": "bounds drawn blindly"}
                kinds.setdefault(kind.get(asked, "contradictions"), Counter())[code] += 1
    return [
        (kind, codes.total(), codes[DONE], codes[INFEASIBLE], codes[USAGE]) for kind, codes in sorted(kinds.items())
    ]
