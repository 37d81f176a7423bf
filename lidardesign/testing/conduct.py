"""Laws of what a task does to the process that runs it: random state, files, environment, time and memory."""

from __future__ import annotations

from lidardesign.run.clock import peak_memory_bytes
from lidardesign.testing.law import GIBIBYTE, BrokenLawError, Law, LawHolds, NotApplicable, Subject

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
        return NotApplicable("this system does not tell what a process holds")
    if peak > subject.limits.memory_bytes:
        raise BrokenLawError(
            f"the process held {peak / GIBIBYTE:.2f} GiB",
            allowed=f"{subject.limits.memory_bytes / GIBIBYTE:.2f} GiB",
            hint="check fewer or smaller scenes (--set), or allow more (--memory-mb)",
        )
    return LawHolds(f"the process held {peak / MEBIBYTE:.0f} MiB at most", {"peak_bytes": peak})


_AFTER = ("scores are numbers", "residuals are places")
LAWS = (
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
