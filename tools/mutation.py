"""How many small changes of the core's code its tests notice: `python tools/mutation.py` (see `make mutation`).

Every mutant (`mutants.py`) of a module meets the module's own fast test files in a forked process (`mutant_tests.py`);
nothing on disk is changed. Interrupted and started again it goes on behind those that are tested. What survives is
listed with the reason that `mutation_reasons.yaml` gives.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import os
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import yaml
from hypothesis import HealthCheck, Phase, settings
from mutant_tests import Children, try_mutants
from mutants import Mutant, mutants_of

ROOT = Path(__file__).resolve().parent.parent
# The files that test each module. A change outside of functions meets the first one alone, whole.
TESTS = {
    "lidardesign/numerics.py": ("test_numerics.py",),
    "lidardesign/design/mixture/mixture.py": ("design/test_mixture.py",),
    "lidardesign/design/constraints/document.py": ("design/test_constraints.py", "design/test_check.py"),
    "lidardesign/design/layouts/rays.py": (
        "design/test_rays.py", "design/test_catalog.py", "design/test_track.py", "workflow/test_select_rays.py",
    ),
}  # fmt: skip
# Packages and modules that a mutant is to meet anew; the tests are too.
OURS = {"lidardesign", "lidardesign_tasks"}
WANTED = 0.85


@dataclass(frozen=True)
class Outcome:
    """What became of one mutant: `killed`, `timeout` (killed too) or `survived`."""

    key: str
    operator: str
    line: int
    before: str
    after: str
    outcome: str


class Record:
    """The outcomes of a module's mutants, one a line of a file in `build/long`.

    Arguments:
        module: The module.
        retry: Whether those count that another commit's tests killed in the same source.
    """

    def __init__(self, module: str, retry: bool) -> None:
        from support.pieces import Pieces

        self.module = module
        name = f"mutation.{module.replace('/', '.')}"
        self.pieces = Pieces(name, still=lambda outcome: retry and outcome["outcome"] != "survived")

    def read(self) -> list[Outcome]:
        """All outcomes, by line of the module."""
        found = (Outcome(**outcome) for outcome in self.pieces.done.values())
        return sorted(found, key=lambda one: (one.line, one.operator))

    def tell(self, mutant: Mutant, outcome: str) -> None:
        """Write down what became of a mutant."""
        one = Outcome(key_of(mutant), mutant.operator, mutant.line, mutant.before, mutant.after, outcome)
        self.pieces.keep(one.key, asdict(one))
        if outcome == "survived":
            print(f"{self.module}:{one.line} {one.operator}\n  - {one.before}\n  + {one.after}", flush=True)


def key_of(mutant: Mutant) -> str:
    """What names the changed source."""
    return hashlib.sha256(mutant.code.encode()).hexdigest()[:16]


def run_module(module: str, jobs: int, retry: bool, sample: int | None) -> int:
    """Test mutants of a module that were not yet, in this process, which imports for it; pytest's exit code."""
    path, name = ROOT / module, module.removesuffix(".py").replace("/", ".")
    files = [str(ROOT / "tests" / name) for name in TESTS[module]]
    found, record = mutants_of(path.read_text()), Record(module, retry)
    found = found if sample is None else found[:: max(1, len(found) // sample)]
    record.pieces.only({key_of(mutant) for mutant in found})
    known = record.pieces.done
    waiting = [mutant for mutant in found if key_of(mutant) not in known]
    ours = OURS | {"tests", *(folder.name for folder in (ROOT / "tests").iterdir() if folder.is_dir())}
    return try_mutants(path, name, files, waiting, Children(jobs, record.tell), ours) if waiting else 0


def report(results: dict[str, list[Outcome]], minutes: float, retry: bool) -> str:
    """The result as a page: a row per module, then the survivors that no reason is written down for."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True)
    rows = ["| Module | Mutants | Killed | of these by time | Survived | Killed |", "|---|--:|--:|--:|--:|--:|"]
    for module, found in results.items():
        alive = sum(one.outcome == "survived" for one in found)
        late = sum(one.outcome == "timeout" for one in found)
        share = killed_share(found)
        rows.append(f"| `{module}` | {len(found)} | {len(found) - alive} | {late} | {alive} | {share:.1%} |")
    about = (
        f"{datetime.date.today()}, commit {commit.stdout.strip()}, {minutes:.0f} minutes. Mutants by the operators of "
        "cosmic-ray, as `tools/mutants.py` chooses them; each meets only its module's own test files"
        + (", and those that died before in the same source are not tested again:" if retry else ":")
    )
    tests = [f"- `{module}`: " + ", ".join(f"`tests/{name}`" for name in TESTS[module]) for module in results]
    return "\n".join(["# Mutation", "", about, "", *tests, "", *rows, "", *_survivors(results)]) + "\n"


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
        yield f"\n`{module}` line {one.line}, {one.operator}:\n"
        yield f"```diff\n- {one.before}\n+ {one.after}\n```"


def _reasons() -> dict[tuple[str, str, str], str]:
    """Reasons by module, the line and what it became."""
    entries = yaml.safe_load((Path(__file__).parent / "mutation_reasons.yaml").read_text()) or []
    return {(one["module"], one["before"], after): one["reason"] for one in entries for after in one["after"]}


def main() -> int:
    """Run the mutants; exit code 1 where a module's tests kill fewer than are wanted."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("modules", nargs="*", default=list(TESTS), help="modules, as lidardesign/numerics.py; all")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes at once; one for each core")
    parser.add_argument("--retry", action="store_true", help="what another commit killed in the same source counts")
    parser.add_argument("--sample", type=int, help="about so many mutants of each module, evenly spread")
    parser.add_argument("--out", type=Path, help="write the page there")
    options = parser.parse_args()
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tasks")]
    _own_hypothesis_profile()
    for module in options.modules:
        # what one module's process imports must not be there for the next
        child = os.fork()
        if not child:
            os._exit(_status_of(lambda m=module: run_module(m, options.jobs, options.retry, options.sample)))
        if os.waitpid(child, 0)[1]:
            return 2
    records = [Record(module, options.retry) for module in options.modules]
    results = {record.module: record.read() for record in records}
    for module, found in results.items():
        print(f"{module}: {killed_share(found):.1%} killed", flush=True)
    if options.out is not None:
        options.out.write_text(report(results, sum(record.pieces.earlier_s for record in records) / 60, options.retry))
    return int(min(map(killed_share, results.values())) < WANTED)


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
