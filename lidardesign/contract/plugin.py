"""The contract of task plugins in pytest: a test that asks for `task_law` runs once per task and law.

The tasks are those of the setting `lidardesign_tasks` in the project's pytest configuration, one a line, each with
settings as `--set` takes them:

    [tool.pytest.ini_options]
    lidardesign_tasks = ["landmark train=3 test=3"]

pytest loads this module wherever lidardesign is installed, so it imports nothing of it until a test asks.
"""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from lidardesign.contract.contract import Contract

SETTING = "lidardesign_tasks"
FIXTURE = "task_law"


class TaskLaw:
    """One law of the contract, to be tried on one task.

    Arguments:
        contract: Of the task.
        name: The law's name.
    """

    def __init__(self, contract: Contract, name: str) -> None:
        self.contract, self.name = contract, name

    def check(self) -> str:
        """Try the law and return its measurements; skip the test where it does not apply, fail it where broken."""
        finding = self.contract.finding(self.name)
        if finding.outcome == "skip":
            pytest.skip(finding.detail)
        if finding.outcome == "fail":
            pytest.fail(f"{finding.law}: {finding.detail}", pytrace=False)
        return finding.detail


def pytest_addoption(parser: pytest.Parser) -> None:
    """Declare the setting."""
    parser.addini(SETTING, "tasks of lidardesign whose contract is tried: NAME [KEY=VALUE]...", type="linelist")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One test per task of the setting and law of the contract."""
    if FIXTURE not in metafunc.fixturenames:
        return
    specifications = metafunc.config.getini(SETTING)
    if not specifications:
        raise pytest.UsageError(f"{metafunc.definition.nodeid} asks for {FIXTURE}: name tasks in {SETTING}")
    from lidardesign.contract.contract import LAWS

    cases = [(specification, law.name) for specification in specifications for law in LAWS]
    names = [f"{specification.split()[0]}: {law}" for specification, law in cases]
    metafunc.parametrize(FIXTURE, cases, indirect=True, ids=names)


@pytest.fixture(scope="session")
def _task_contracts() -> dict[str, Contract]:
    """A cache of contracts by lines of the setting, so that scenes are made once for all laws."""
    return {}


@pytest.fixture
def task_law(request: pytest.FixtureRequest, _task_contracts: dict[str, Contract]) -> TaskLaw:
    """One law of the contract of one task that the setting `lidardesign_tasks` names."""
    specification, law = request.param
    if specification not in _task_contracts:
        from lidardesign.contract.contract import contract_of
        from lidardesign.registry import load_task

        name, *overrides = shlex.split(specification)
        _task_contracts[specification] = contract_of(load_task(name), overrides=overrides)
    return TaskLaw(_task_contracts[specification], law)
