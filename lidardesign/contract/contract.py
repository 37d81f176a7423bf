"""The whole contracts of task plugins, formats and methods, law by law, each tried once.

The laws of random state and time are here, the others in the modules of their groups.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lidardesign.config import RunConfig, resolve
from lidardesign.contract import formats, methods, scenes, scoring
from lidardesign.contract.law import (
    CALL_SECONDS,
    BrokenLawError,
    Finding,
    Law,
    LawHolds,
    NotApplicable,
    Subject,
    Tried,
    error_words,
    place_of,
    restore_random_states,
)
from lidardesign.errors import ConfigError, LidardesignError, text_of
from lidardesign.plugins import PluginKind, plugin_guard
from lidardesign.task import Task, check_interface


def check_random(subject: Tried) -> LawHolds:
    """No global random state is drawn from or seeded."""
    if subject.drawn:
        raise BrokenLawError(
            f"uses {', '.join(subject.drawn)}",
            hint="draw from lidardesign.task.random_generator(seed, ...) and pass the generator on",
        )
    return LawHolds("Python's, numpy's and torch's random states are as they were")


def check_time(subject: Tried) -> LawHolds:
    """Every call of the plugin's code ends within the limit."""
    limit = subject.limit_s
    slow = [what for what, seconds in subject.seconds.items() if seconds > limit]
    if slow:
        raise BrokenLawError(
            f"{slow[0]} took {subject.seconds[slow[0]]:.1f} s",
            allowed=f"{limit:g} s",
            hint=("check fewer or smaller scenes (--set), or " * (subject.noun == "task")) + "allow more (--seconds)",
        )
    said = ", ".join(f"{what} {seconds:.3f} s" for what, seconds in subject.seconds.items())
    return LawHolds(f"at most: {said}", {f"{what}_s": round(seconds, 4) for what, seconds in subject.seconds.items()})


def _with_conduct(*laws: Law, after: tuple[str, ...]) -> tuple[Law, ...]:
    """Laws, and those of conduct, which look at calls that were made for some of them."""
    return (
        *laws,
        Law("no global random state", "conduct", "no global random state is used", check_random, after=after),
        Law("within time", "conduct", "every call ends in time", check_time, after=after),
    )


LAWS = _with_conduct(
    *scenes.INTERFACE_LAWS, *scenes.SCENE_LAWS, *scoring.LAWS, after=("scores are numbers", "returns inform")
)
FORMAT_LAWS = _with_conduct(*formats.LAWS, after=("designs are written", "says what it holds", "rays come back"))
METHOD_LAWS = _with_conduct(*methods.LAWS, after=("designs are made", "designs repeat"))
SUBJECTS = {"format": formats.FormatSubject, "method": methods.MethodSubject}
LAWS_OF = {"task": LAWS, "format": FORMAT_LAWS, "method": METHOD_LAWS}


class Contract:
    """The laws of one plugin, of a task with one configuration, each tried when it is asked for, and once.

    Arguments:
        subject: The plugin.
    """

    def __init__(self, subject: Tried) -> None:
        self.subject = subject
        self._laws: Mapping[str, Law] = {law.name: law for law in LAWS_OF[subject.noun]}
        self._findings: dict[str, Finding] = {}

    def finding(self, name: str) -> Finding:
        """The finding of a law.

        Raises:
            ConfigError: There is no law of this name.
        """
        if name not in self._laws:
            raise ConfigError(f"unknown law {name!r}", where="law", allowed=", ".join(self._laws))
        if name not in self._findings:
            self._findings[name] = self._tried(self._laws[name])
        return self._findings[name]

    def findings(self) -> Iterator[Finding]:
        """The finding of each law, in order."""
        yield from map(self.finding, self._laws)

    def _tried(self, law: Law) -> Finding:
        known = (law.name, law.group, law.statement)
        for earlier in law.after:
            self.finding(earlier)
        for needed in law.needs:
            if self.finding(needed).outcome != "pass" and not (
                self.finding(needed).outcome == "skip" and not self.finding(needed).detail.startswith("needs: ")
            ):
                return Finding(*known, "skip", f"needs: {needed}")
        started = time.perf_counter()
        try:
            found = law.check(self.subject)
        except Exception as error:  # what a task gives instead of what it should surprises in any way
            is_ours = isinstance(error, LidardesignError)
            words = error_words(error) if is_ours else f"{type(error).__name__}: {text_of(error)}{place_of(error)}"
            return Finding(*known, "fail", words, time.perf_counter() - started)
        seconds = time.perf_counter() - started
        if isinstance(found, NotApplicable):
            return Finding(*known, "skip", found.reason, seconds)
        return Finding(*known, "pass", found.words, seconds, found.figures)


def contract_of(
    task: Task,
    *,
    overrides: Sequence[str] = (),
    config: RunConfig | None = None,
    limit_s: float = CALL_SECONDS,
) -> Contract:
    """The contract of a task object, registered or not.

    Arguments:
        task: The task.
        overrides: `KEY=VALUE` as `--set` takes it.
        config: A whole configuration instead.
        limit_s: Time limit of one call of the task's code [s].

    Raises:
        PluginError: The task lacks a member of the interface.
        ConfigError: The configuration is refused.
    """
    with plugin_guard(str(getattr(task, "name", type(task).__name__))):
        check_interface(str(getattr(task, "name", "")), task)
    drawn: list[str] = []
    if config is None:
        with restore_random_states(drawn, "space"):
            config = resolve(task, overrides=overrides)
    return Contract(Subject(task, config, limit_s, drawn))


def contract_of_plugin(kind: PluginKind[Any], plugin: Any) -> Contract:
    """The contract of a format or of a method, registered or not.

    Raises:
        PluginError: The plugin lacks a member of the interface.
    """
    name = str(getattr(plugin, "name", ""))
    with plugin_guard(name or type(plugin).__name__, kind.noun):
        kind.check(name, plugin)
    return Contract(SUBJECTS[kind.noun](plugin))


def check_task(task: Task, *, overrides: Sequence[str] = (), limit_s: float = CALL_SECONDS) -> list[Finding]:
    """Try the whole contract on a task object, in this process.

    Arguments:
        task: The task.
        overrides: `KEY=VALUE` as `--set` takes it.
        limit_s: Time limit of one call of the task's code [s].

    Raises:
        BrokenLawError: A law does not hold; the message names all that do not.
    """
    findings = list(contract_of(task, overrides=overrides, limit_s=limit_s).findings())
    refuse_broken(f"task {task.name}", findings)
    return findings


def refuse_broken(where: str, findings: Sequence[Finding]) -> None:
    """Name the laws that do not hold.

    Raises:
        BrokenLawError: There are some.
    """
    broken = [finding for finding in findings if finding.outcome == "fail"]
    if broken:
        listed = "; ".join(f"{finding.law}: {finding.detail}" for finding in broken)
        raise BrokenLawError(f"broken laws: {len(broken)} of {len(findings)}: {listed}", where=where)
