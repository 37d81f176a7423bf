"""Random whole runs, `make soak-runs`: no fault, every constraint kept, the same bytes when done again.

`pytest -m long -s tests/soak/test_long_runs.py -k '[SEED]'` does a run again and shows its configuration.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

import pytest
from support.long_runs import amount, ended_after, paragraph, table

from soak.plans import random_plan
from soak.scaled_flatland import offer
from soak.whole_runs import BLIND, DONE, INFEASIBLE, ROUGH, WHOLE, plan_lines, whole_run

NAME, TITLE = "runs", "Random whole runs"
# Minutes on a busy machine; a run that takes this long hangs.
LONGEST_RUN_S = 900.0


def pytest_generate_tests(metafunc):
    metafunc.parametrize("seed", range(amount(metafunc.config)))


@pytest.mark.long
def test_a_random_run_is_without_fault_and_repeats(tmp_path, monkeypatch, piece, seed):
    monkeypatch.syspath_prepend(offer(tmp_path / "offered"))
    print("\n".join(plan_lines(seed)))

    def work():
        with ended_after(LONGEST_RUN_S):
            record, again = (whole_run(random_plan(seed), tmp_path / name) for name in ("run", "again"))
        record.faults += [f"a second run did not repeat {name}" for name in record.differences(again)]
        return {**asdict(record), "outcome": record.outcome}

    piece(work)


def parts(pieces: list[dict]) -> list[str]:
    """What the page says."""
    whole = [one for one in pieces if one["outcome"] == WHOLE]

    def span(key: str) -> str:
        values = [one[key] for one in whole]
        return f"{min(values):.2g} to {max(values):.2g}" if values else "none"

    outcomes = Counter(one["outcome"] for one in pieces)
    meaning = {
        WHOLE: "learned, fitted, constrained, evaluated",
        ROUGH: "learned; `fit` refuses the density as too rough (exit 3, or 4 for so many sensors)",
        BLIND: "`learn` says that the design space sees no target (exit 3)",
        "fault": "a fault",
    }
    names = {"kept already": "bounds that the fit kept already", "drawn": "bounds drawn blindly"}
    kinds: dict[str, Counter[int]] = {}
    for command, asked, code, _ in (step for one in pieces for step in one["steps"]):
        if command == "constrain":
            kinds.setdefault(names.get(asked, "contradictions"), Counter())[code] += 1
    codes = ("constraints", "asked", "kept", "refused with exit 4")
    return [
        paragraph(
            f"{len(whole)} runs did all of learn, fit, constrain and evaluate: widths of {span('size_m')} m, sigma of "
            f"{span('sigma_share')} of the width, {span('free')} free dimensions, {span('sensors')} sensors. "
            f"{sum(one['bounds'] for one in pieces)} bounds were read back from the written files and checked. Each "
            "run was done twice, and is to repeat every document and every byte of densities, samples and designs."
        ),
        table(("how it ended", "runs"), [(text, outcomes[outcome]) for outcome, text in meaning.items()]),
        table(codes, [(kind, n.total(), n[DONE], n[INFEASIBLE]) for kind, n in sorted(kinds.items())]),
    ]
