"""Random plans of effects, `make soak-promise`: nothing that is skipped changes more than is tolerated."""

from __future__ import annotations

import pytest
from support.long_runs import amount

from soak.promise import kept_promise, random_case

NAME, TITLE = "promise", "Random plans of effects"
BLOCK = 50


def pytest_generate_tests(metafunc):
    plans = amount(metafunc.config)
    metafunc.parametrize(("first", "end"), [(at, min(at + BLOCK, plans)) for at in range(0, plans, BLOCK)])


@pytest.mark.long
@pytest.mark.filterwarnings("default")
def test_what_is_skipped_changes_no_more_than_is_tolerated(piece, first, end):
    def work():
        found = {seed: kept_promise(random_case(seed)) for seed in range(first, end)}
        faults = [f"seed {seed}: {kept}" for seed, kept in found.items() if kept.broken]
        return {"plans": len(found), "skipping": sum(bool(kept.skipped) for kept in found.values()), "faults": faults}

    piece(work)


def parts(pieces: list[dict]) -> list[str]:
    """What the page says."""
    plans, skipping = (sum(one[key] for one in pieces) for key in ("plans", "skipping"))
    broken = sum(len(one["faults"]) for one in pieces)
    return [f"{plans} plans, {skipping} of which skip something; {broken} broke their promise."]
