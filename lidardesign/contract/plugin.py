"""The contracts of plugins in pytest: `task_law`, `format_law` and `method_law` run a test per plugin and law.

The plugins are those of the settings `lidardesign_tasks`, `lidardesign_formats` and `lidardesign_methods` in the
project's pytest configuration, one a line, tasks with settings as `--set` takes them:

    [tool.pytest.ini_options]
    lidardesign_tasks = ["landmark train=3 test=3"]
    lidardesign_formats = ["points"]

pytest loads this module wherever lidardesign is installed, so it imports nothing of it until a test asks.
"""

from __future__ import annotations

import shlex
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from lidardesign.contract.contract import Contract

# Settings by fixture.
SETTINGS = {"task_law": "lidardesign_tasks", "format_law": "lidardesign_formats", "method_law": "lidardesign_methods"}


class PluginLaw:
    """One law of a contract, to be tried on one plugin.

    Arguments:
        contract: Of the plugin.
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
    """Declare the settings."""
    parser.addini(
        SETTINGS["task_law"], "tasks of lidardesign whose contract is tried: NAME [KEY=VALUE]...", type="linelist"
    )
    for kind in ("format", "method"):
        told = f"{kind}s of lidardesign whose contract is tried: NAME"
        parser.addini(SETTINGS[f"{kind}_law"], told, type="linelist")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One test per plugin of the setting and law of its contract."""
    for fixture in SETTINGS.keys() & set(metafunc.fixturenames):
        setting = SETTINGS[fixture]
        specifications = metafunc.config.getini(setting)
        if not specifications:
            raise pytest.UsageError(
                f"{metafunc.definition.nodeid} asks for {fixture}: name {setting.partition('_')[2]} in {setting}"
            )
        from lidardesign.contract.process import statements_of

        laws = [law for law, *_ in statements_of(fixture.partition("_")[0])[1:]]
        cases = [(specification, law) for specification in specifications for law in laws]
        names = [f"{specification.split()[0]}: {law}" for specification, law in cases]
        metafunc.parametrize(fixture, cases, indirect=True, ids=names)


@pytest.fixture(scope="session")
def _contracts() -> dict[str, Contract]:
    """A cache of contracts by lines of the settings, so that scenes are made once for all laws."""
    return {}


@pytest.fixture
def task_law(request: pytest.FixtureRequest, _contracts: dict[str, Contract]) -> PluginLaw:
    """One law of the contract of one task that the setting `lidardesign_tasks` names."""
    return _plugin_law("task", *request.param, _contracts)


@pytest.fixture
def format_law(request: pytest.FixtureRequest, _contracts: dict[str, Contract]) -> PluginLaw:
    """One law of the contract of one format that the setting `lidardesign_formats` names."""
    return _plugin_law("format", *request.param, _contracts)


@pytest.fixture
def method_law(request: pytest.FixtureRequest, _contracts: dict[str, Contract]) -> PluginLaw:
    """One law of the contract of one method that the setting `lidardesign_methods` names."""
    return _plugin_law("method", *request.param, _contracts)


def _plugin_law(noun: str, specification: str, law: str, contracts: dict[str, Contract]) -> PluginLaw:
    from lidardesign.contract.contract import contract_of, contract_of_plugin
    from lidardesign.contract.process import KINDS

    key = f"{noun} {specification}"
    if key not in contracts:
        name, *overrides = shlex.split(specification) if noun == "task" else [specification]
        plugin = KINDS[noun].load(name)
        contracts[key] = (
            contract_of(plugin, overrides=overrides) if noun == "task" else contract_of_plugin(KINDS[noun], plugin)
        )
    return PluginLaw(contracts[key], law)
