"""Long runs that go on where they were interrupted: a line per finished piece in `build/long`, all of one commit.

Whatever interrupts a run, a line is there or it is not; one that is cut does not count. Of another commit, or of a
program that was changed meanwhile, nothing counts. LONG_RUNS in the environment names another folder.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FOLDER = Path(os.environ.get("LONG_RUNS", ROOT / "build" / "long"))
PROGRAM = ("lidardesign", "tasks", "tests", "tools")


class Pieces:
    """The finished pieces of a long run, by their keys.

    Arguments:
        name: The run's, and its file's.
        folder: Where that file is.
        origin: Says of which program the pieces are; the commit, and what was changed since.
        still: Which results of another program count all the same.
    """

    def __init__(
        self,
        name: str,
        folder: Path | None = None,
        origin: Callable[[], str] | None = None,
        still: Callable[[Any], bool] = lambda _: False,
    ) -> None:
        self.path = (FOLDER if folder is None else folder) / f"{name}.jsonl"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._program = program if origin is None else origin
        self._origin = self._program()
        self._lock, self._began, self.earlier_s = threading.Lock(), time.monotonic(), 0.0
        begun, *lines = _lines(self.path) or [{}]
        lines = [line for line in lines if line.keys() == {"key", "value", "seconds"}]
        is_same = begun.get("origin") == self._origin
        self._lines = [line for line in lines if is_same or still(line["value"])]
        self.earlier_s = max((line["seconds"] for line in self._lines), default=0.0)
        dropped = len(lines) - len(self._lines)
        if dropped:
            _tell(f"{name}: {dropped} pieces of another program, {begun.get('origin')}, are dropped")
        if self._lines:
            _tell(f"{name}: goes on behind {len(self._lines)} pieces; without {self.path} it would begin anew")
        self._write()

    def _write(self) -> None:
        """Write the file anew: no line stands behind one that was cut."""
        self.path.write_text("".join(json.dumps(line) + "\n" for line in ({"origin": self._origin}, *self._lines)))

    @property
    def done(self) -> dict[str, Any]:
        """What became of the finished pieces, by their keys."""
        return {line["key"]: line["value"] for line in self._lines}

    def only(self, keys: Collection[str]) -> None:
        """Forget all other pieces."""
        self._lines = [line for line in self._lines if line["key"] in keys]
        self._write()

    @property
    def seconds(self) -> float:
        """Wall time until now, of all times that it was at work [s]."""
        return self.earlier_s + time.monotonic() - self._began

    def keep(self, key: str, value: Any) -> None:
        """Write down what became of a piece; from any thread.

        Raises:
            SystemExit: The program is not what it was at the beginning: nobody knows of which the piece is.
        """
        if self._program() != self._origin:
            raise SystemExit(f"{self.path.stem}: ends, as the program was changed meanwhile; run it in a clone")
        text = json.dumps({"key": key, "value": value, "seconds": round(self.seconds, 3)})
        with self._lock, self.path.open("a") as file:
            self._lines.append(json.loads(text))
            file.write(text + "\n")

    def of(self, key: str, work: Callable[[], Any]) -> Any:
        """What became of a piece: as it is written, or of working for it now."""
        if key not in self.done:
            self.keep(key, work())
        return self.done[key]


def _lines(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a file."""
    lines = []
    for text in path.read_text(errors="replace").splitlines() if path.exists() else []:
        with contextlib.suppress(ValueError):
            lines.append(json.loads(text))
    return [line for line in lines if isinstance(line, dict)]


def program() -> str:
    """Of which program a result is: the commit, and a digest of what was changed since."""
    changed = _git("diff", "HEAD", "--", *PROGRAM)
    for name in _git("ls-files", "--others", "--exclude-standard", "--", *PROGRAM).decode().splitlines():
        changed += name.encode() + (ROOT / name).read_bytes()
    number = _git("rev-parse", "--short", "HEAD").decode().strip() or "unknown"
    return f"{number} with changes {hashlib.sha256(changed).hexdigest()[:12]}" if changed else number


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, check=False).stdout


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
