"""How far work has come: a bar that changes on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Self

from lidardesign.cli.terminal.grids import duration

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

# Between two lines away from a terminal: such a share of all the time that it takes, but so long at least and at most.
SHARE = 0.2
LEAST_S, MOST_S = 10.0, 600.0


class ProgressDisplay:
    """Shows how far work has come, while it is a context.

    Arguments:
        label: What is done, where `show` does not say.
        say: Prints a line away from a terminal.
        console: The terminal's, or None.
    """

    def __init__(self, label: str, say: Callable[[str], None], console: Console | None) -> None:
        self.label, self.say, self.console = label, say, console
        self.began_s = self.said_s = time.monotonic()
        self.bar: Progress | None = None
        self.lines: dict[str, Any] = {}
        # when counted work began, and with how much done
        self.firsts: dict[str, tuple[float, float]] = {}

    def __enter__(self) -> Self:
        if self.console is not None:
            from rich.progress import BarColumn, Progress, TextColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[detail]}"))
            self.bar = Progress(*columns, console=self.console, transient=True)
            self.bar.start()
            self.show()
        return self

    def __exit__(self, *error: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def show(
        self,
        done: float = 0,
        total: float = 0,
        *,
        label: str | None = None,
        detail: str = "",
        left_s: float | None = None,
        line: str = "",
    ) -> None:
        """Show where the work is.

        Arguments:
            done: How much of it is done.
            total: How much there is; 0 where that is not known.
            label: What is done now.
            detail: More of it.
            left_s: The time that remains; by default what follows from the time until now [s].
            line: The name of the line, where there are several.
        """
        now_s, label = time.monotonic(), self.label if label is None else label
        began_s, first = self.firsts.setdefault(line, (now_s, done)) if total else (now_s, done)
        if left_s is None and first < done <= total:
            left_s = (now_s - began_s) * (total - done) / (done - first)
        share = f"{100 * done / total:.0f} %" if done and total else ""
        left = f"{duration(left_s)} left" if left_s is not None else ""
        text = ", ".join(filter(None, [share, detail, left]))
        if self.bar is not None:
            if line not in self.lines:
                self.lines[line] = self.bar.add_task(label, total=None, detail="")
            self.bar.update(self.lines[line], description=label, completed=done, total=total or None, detail=text)
        elif now_s - self.said_s >= min(max(LEAST_S, SHARE * (now_s - self.began_s + (left_s or 0.0))), MOST_S):
            self.said_s = now_s
            self.say(f"{label}: {text}" if text else f"{label} ...")
