"""The whole contract of a task plugin, law by law, each tried once.

Laws of what a task does to the process that runs it: random state, files, environment, time and memory.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence

from lidardesign import registry
from lidardesign.config import RunConfig, resolve
from lidardesign.errors import ConfigError, LidardesignError
from lidardesign.registry import text_of
from lidardesign.run.clock import peak_memory_bytes
from lidardesign.task import Task
from lidardesign.testing import geometry, interface, scenes, scoring
from lidardesign.testing.law import (
    GIBIBYTE,
    BrokenLawError,
    Finding,
    Law,
    LawHolds,
    Limits,
    NotApplicable,
    Subject,
    error_words,
    place_of,
)
from lidardesign.testing.watch import Watch

MEBIBYTE = 2**20


def check_random(subject: Subject) -> LawHolds:
    """No global random state is drawn from or seeded."""
    if subject.watch.drawn:
        raise BrokenLawError(
            f"uses {', '.join(subject.watch.drawn)}",
            hint="draw from lidardesign.task.random_generator(seed, ...) and pass the generator on",
        )
    return LawHolds("Python's, numpy's and torch's random states are as they were")


def check_files(subject: Subject) -> LawHolds:
    """Nothing is written but temporary files and caches."""
    found = subject.watch.written_files()
    if found:
        raise BrokenLawError(f"writes {', '.join(found)}", allowed="temporary files and the user's caches")
    return LawHolds("nothing but temporary files and caches")


def check_surroundings(subject: Subject) -> LawHolds:
    """The working folder, the environment, the locale, signals and numpy's error settings stay."""
    if subject.watch.changed:
        raise BrokenLawError(f"changes {', '.join(subject.watch.changed)}", hint="put back what you change")
    return LawHolds("working folder, environment, locale, signals and numpy's error settings are as they were")


def check_time(subject: Subject) -> LawHolds:
    """Every call of the task's code ends within the limit."""
    limit = subject.limits.seconds
    slow = [what for what, seconds in subject.seconds.items() if seconds > limit]
    if slow:
        raise BrokenLawError(
            f"{slow[0]} took {subject.seconds[slow[0]]:.1f} s",
            allowed=f"{limit:g} s",
            hint="check fewer or smaller scenes (--set), or allow more (--seconds)",
        )
    said = ", ".join(f"{what} {seconds:.3f} s" for what, seconds in subject.seconds.items())
    return LawHolds(f"at most: {said}", {f"{what}_s": round(seconds, 4) for what, seconds in subject.seconds.items()})


def check_memory(subject: Subject) -> LawHolds | NotApplicable:
    """The process holds no more memory than the limit."""
    peak = peak_memory_bytes()
    if peak is None:
        return NotApplicable("this system does not say how much memory a process holds")
    if peak > subject.limits.memory_bytes:
        raise BrokenLawError(
            f"the process used {peak / GIBIBYTE:.2f} GiB",
            allowed=f"{subject.limits.memory_bytes / GIBIBYTE:.2f} GiB",
            hint="check fewer or smaller scenes (--set), or allow more (--memory-mb)",
        )
    return LawHolds(f"the process used {peak / MEBIBYTE:.0f} MiB at most", {"peak_bytes": peak})


_AFTER = ("scores are numbers", "returns inform")
CONDUCT_LAWS = (
    Law("no global random state", "conduct", "no global random state is used", check_random, after=_AFTER),
    Law("nothing is written", "conduct", "only temporary files and caches are written", check_files, after=_AFTER),
    Law(
        "nothing else is changed",
        "conduct",
        "working folder, environment, locale and signals stay",
        check_surroundings,
        after=_AFTER,
    ),
    Law("within time", "conduct", "every call ends in time", check_time, after=_AFTER),
    Law("within memory", "conduct", "the process stays within memory", check_memory, after=_AFTER),
)


LAWS: tuple[Law, ...] = (*interface.LAWS, *scenes.LAWS, *geometry.LAWS, *scoring.LAWS, *CONDUCT_LAWS)


class Contract:
    """The laws of one task with one configuration, each tried when it is asked for, and once.

    Arguments:
        subject: The task.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self._laws: Mapping[str, Law] = {law.name: law for law in LAWS}
        self._findings: dict[str, Finding] = {}

    def finding(self, name: str) -> Finding:
        """What became of a law.

        Raises:
            ConfigError: There is no law of this name.
        """
        if name not in self._laws:
            raise ConfigError(f"unknown law {name!r}", where="law", allowed=", ".join(self._laws))
        if name not in self._findings:
            self._findings[name] = self._tried(self._laws[name])
        return self._findings[name]

    def findings(self) -> Iterator[Finding]:
        """What became of each law, in order."""
        for law in LAWS:
            yield self.finding(law.name)

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
        except LidardesignError as error:
            return Finding(*known, "fail", error_words(error), time.perf_counter() - started)
        except MemoryError:
            limit = self.subject.limits.memory_bytes
            return Finding(*known, "fail", f"needs more than {limit / 2**20:.0f} MiB", time.perf_counter() - started)
        except Exception as error:  # what a task gives instead of what it should surprises in any way
            return Finding(
                *known,
                "fail",
                f"{type(error).__name__}: {text_of(error)}{place_of(error)}",
                time.perf_counter() - started,
            )
        seconds = time.perf_counter() - started
        if isinstance(found, NotApplicable):
            return Finding(*known, "skip", found.reason, seconds)
        return Finding(*known, "pass", found.words, seconds, found.figures)


def contract_of(
    task: Task,
    *,
    overrides: Sequence[str] = (),
    config: RunConfig | None = None,
    limits: Limits | None = None,
    watch: Watch | None = None,
) -> Contract:
    """The contract of a task object, registered or not.

    Arguments:
        task: The task.
        overrides: `KEY=VALUE` as `--set` takes it.
        config: A whole configuration instead.
        limits: What the task's code may take.
        watch: Notes what its code does.

    Raises:
        PluginError: The task lacks a member of the interface.
        ConfigError: The configuration is refused.
    """
    with registry.plugin_guard(str(getattr(task, "name", type(task).__name__))):
        registry.check_interface(str(getattr(task, "name", "")), task)
    watch = watch or Watch()
    if config is None:
        with watch.during("space"):
            config = resolve(task, overrides=overrides)
    return Contract(Subject(task, config, limits or Limits(), watch))


def check_task(task: Task, *, overrides: Sequence[str] = (), limits: Limits | None = None) -> list[Finding]:
    """Try the whole contract on a task object, in this process.

    Arguments:
        task: The task.
        overrides: `KEY=VALUE` as `--set` takes it.
        limits: What the task's code may take.

    Raises:
        BrokenLawError: A law does not hold; the message names all that do not.
    """
    findings = list(contract_of(task, overrides=overrides, limits=limits).findings())
    refuse_broken(task.name, findings)
    return findings


def refuse_broken(name: str, findings: Sequence[Finding]) -> None:
    """Name the laws that do not hold.

    Raises:
        BrokenLawError: There are some.
    """
    broken = [finding for finding in findings if finding.outcome == "fail"]
    if broken:
        listed = "; ".join(f"{finding.law}: {finding.detail}" for finding in broken)
        raise BrokenLawError(f"{len(broken)} of {len(findings)} laws are broken: {listed}", where=f"task {name}")
