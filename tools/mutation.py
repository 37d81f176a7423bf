"""How many small changes of the core's code its tests notice: `python tools/mutation.py` (see `make mutation`).

Every mutant (`mutants.py`) of a module meets the module's own fast test files in a forked process (`mutant_tests.py`);
nothing on disk is changed. Interrupted and started again it goes on behind the modules that are done. What survives is
listed with the reason that `mutation_reasons.yaml` gives.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import yaml
from hypothesis import HealthCheck, Phase, settings
from mutant_tests import Children, try_mutants
from mutants import Mutant, mutants_of

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tasks")]
from benchmarks.soak.long_runs import heading, kept, table, write_page  # noqa: E402

# The files that test each module. A change outside of functions meets the first one alone, whole.
TESTS = {
    "lidardesign/numerics.py": ("test_numerics.py",),
    "lidardesign/mixture/components.py": ("mixture/test_mixture.py",),
    "lidardesign/constraints/document.py": (
        "constraints/test_constraints.py", "constraints/test_check.py", "constraints/test_hard_constraints.py",
    ),
    "lidardesign/sensors/pattern.py": (
        "sensors/test_pattern.py", "sensors/test_rays.py", "sensors/test_designs.py", "density/test_samplers.py",
    ),
    "lidardesign/rays/choice.py": (
        "rays/test_search.py", "rays/test_choice.py", "rays/test_groups.py",
        "rays/test_certified.py", "rays/test_selection.py", "rays/test_adaptive.py",
    ),
}  # fmt: skip
# Packages and modules that a mutant is to meet anew; the tests are too.
OURS = {"lidardesign", "lidardesign_tasks"}
# Of the mutants of all modules together
WANTED = 0.95


@dataclass(frozen=True)
class Outcome:
    """What became of one mutant: `killed`, `timeout` (killed too) or `survived`."""

    operator: str
    line: int
    before: str
    after: str
    outcome: str


def outcomes(module: str, jobs: int, sample: int | None) -> list[dict[str, Any]]:
    """What became of a module's mutants, tested in a process that imports for it alone, by line."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "outcomes"
        child = os.fork()
        if not child:
            os._exit(_status_of(lambda: _run_module(module, jobs, sample, path)))
        if os.waitpid(child, 0)[1]:
            raise SystemExit(f"the mutants of {module} could not be tested")
        found = [json.loads(line) for line in path.read_text().splitlines()]
    return sorted(found, key=lambda one: (one["line"], one["operator"]))


def _run_module(module: str, jobs: int, sample: int | None, out: Path) -> int:
    path, name = ROOT / module, module.removesuffix(".py").replace("/", ".")
    mutants = mutants_of(path.read_text())
    mutants = mutants if sample is None else mutants[:: max(1, len(mutants) // sample)]
    ours = OURS | {"tests", *(folder.name for folder in (ROOT / "tests").iterdir() if folder.is_dir())}

    def tell(mutant: Mutant, outcome: str) -> None:
        one = Outcome(mutant.operator, mutant.line, mutant.before, mutant.after, outcome)
        with out.open("a") as file:
            file.write(json.dumps(asdict(one)) + "\n")
        if outcome == "survived":
            print(f"{module}:{one.line} {one.operator}\n  - {one.before}\n  + {one.after}", flush=True)

    files = [str(ROOT / "tests" / file) for file in TESTS[module]]
    return try_mutants(path, name, files, mutants, Children(jobs, tell), ours)


def report(results: dict[str, list[Outcome]], command: str) -> list[str]:
    """The parts of the page: a row per module, then the survivors that no reason is written down for."""
    rows = []
    for module, found in results.items():
        alive, late = (sum(one.outcome == outcome for one in found) for outcome in ("survived", "timeout"))
        rows.append((f"`{module}`", len(found), len(found) - alive, late, alive, f"{killed_share(found):.1%}"))
    tests = [f"- `{module}`: " + ", ".join(f"`tests/{name}`" for name in TESTS[module]) for module in results]
    about = "Mutants by the operators of cosmic-ray, chosen by `tools/mutants.py`; each meets only its module's tests"
    columns = ("Module", "Mutants", "Killed", "of these by time", "Survived", "Killed")
    return [heading("Mutation", command), f"{about}:", "\n".join(tests), table(columns, rows), *_survivors(results)]


def killed_share(found: list[Outcome]) -> float:
    """Share of the mutants that did not survive."""
    return sum(one.outcome != "survived" for one in found) / len(found)


def _survivors(results: dict[str, list[Outcome]]) -> Iterator[str]:
    reasons = _reasons()
    alive = [(module, one) for module, found in results.items() for one in found if one.outcome == "survived"]
    unexplained = [(m, one) for m, one in alive if (m, one.before, one.after) not in reasons]
    explained = len(alive) - len(unexplained)
    yield f"{explained} of {len(alive)} survivors have their reason in `tools/mutation_reasons.yaml`."
    for module, one in unexplained:
        yield f"`{module}` line {one.line}, {one.operator}:"
        yield f"```diff\n- {one.before}\n+ {one.after}\n```"


def _reasons() -> dict[tuple[str, str, str], str]:
    """Reasons by module, the line and what it became."""
    entries = yaml.safe_load((Path(__file__).parent / "mutation_reasons.yaml").read_text()) or []
    return {(one["module"], one["before"], after): one["reason"] for one in entries for after in one["after"]}


def main() -> int:
    """Run the mutants; exit code 1 where the tests kill fewer than are wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", default=list(TESTS), help="modules, as lidardesign/numerics.py; all")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes at once; one for each core")
    parser.add_argument("--sample", type=int, help="about so many mutants of each module, evenly spread")
    parser.add_argument("--out", type=Path, help="write the page there")
    options = parser.parse_args()
    os.chdir(ROOT)
    _own_hypothesis_profile()
    results = {}
    for module in options.modules:
        key = f"mutation of {module}, {options.sample}"
        found = kept(key, lambda module=module: outcomes(module, options.jobs, options.sample))
        results[module] = [Outcome(**one) for one in found]
        print(f"{module}: {killed_share(results[module]):.1%} killed", flush=True)
    if options.out is not None:
        amount = f" AMOUNT={options.sample}" if options.sample else ""
        write_page(options.out, report(results, f"make mutation{amount}"))
    # of a few nothing follows
    return int(options.sample is None and killed_share(list(chain.from_iterable(results.values()))) < WANTED)


def _status_of(work: Callable[[], int]) -> int:
    """What `work` returns; 2 and its message where it raises."""
    try:
        return work()
    except BaseException:
        traceback.print_exc()
        return 2


def _own_hypothesis_profile() -> None:
    """The same examples for every mutant, none shrunk and none kept."""
    settings.register_profile(
        "mutation",
        max_examples=25,
        deadline=None,
        derandomize=True,
        database=None,
        phases=(Phase.explicit, Phase.generate),
        suppress_health_check=[HealthCheck.too_slow],
    )
    os.environ["HYPOTHESIS_PROFILE"] = "mutation"


if __name__ == "__main__":
    sys.exit(main())
