"""A user who follows a page of the documentation in an empty folder, with small runs where a block says so."""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path

from lidardesign.cli.main import run as run_program
from support.docs_output import difference
from support.docs_pages import Block, Command
from support.small_runs import shifted

# The wide tables of the documentation were printed on a terminal of this width.
COLUMNS = 100
QUICK = (
    "learning.samples=5000", "learning.coverage_proposals=512", "learning.balance_proposals=2048",
    "learning.batch=128", "train=2", "test=2",
)  # fmt: skip
# What `learn` takes further in a small run: a blurred density of few scenes is learned in seconds instead of minutes.
# The blur is wide, so that any seed on any processor is worth several times the samples that fits need.
SMALL = {
    "flatland": (*QUICK, "learning.steps=80", "density.sigma_m=0.06"),
    "face": (*QUICK, "learning.steps=80", "density.sigma_m=0.04", "truth_points=500"),
    "arm": ("learning.samples=10000", *QUICK[1:], "learning.steps=100", "density.sigma_m=0.2", "frames=8"),
    "warehouse": (*QUICK, "learning.steps=120", "density.sigma_m=0.2"),
    "mujoco": (*QUICK, "learning.steps=100", "density.sigma_m=0.1", "frames=4"),
    "meshes": (*QUICK[:-2], "learning.steps=100", "density.sigma_m=0.01", "poses=1", "truth_points=500"),
}
SEED = re.compile(r"(?<=\bseed=)\d+")
SHELL = re.compile(r"[|<>&;`]|\$\(")
# Commands that hand on what they print, into a file in the end, and nothing else that takes a shell.
STAGE = r"(?:[^|<>&;`$()*?~'\"\\]|'[^'|>]*')+"
PIPED = re.compile(rf"{STAGE}(?:\|{STAGE})*(?:>\s*[\w./-]+\s*)?")


@dataclass
class Ran:
    """What a command did."""

    code: int
    out: str
    err: str


@dataclass
class Library:
    """What small runs of all pages share: a task with the same settings is learned once."""

    folder: Path
    known: dict[tuple[str, ...], tuple[Path, Ran]] = field(default_factory=dict)


class Session:
    """One page, followed from its first block to its last in one folder."""

    def __init__(self, folder: Path, library: Library) -> None:
        self.folder, self.library = folder, library
        self.names: dict[str, object] = {"__name__": "__page__"}
        self.last = 0

    def follow(self, block: Block) -> None:
        """Do what a block asks for.

        Raises:
            AssertionError: It does not do what the page says.
        """
        if block.file is not None:
            path = self.folder / block.file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, encoding="utf-8")
        elif block.language == "python":
            self._python(block)

    def command(self, command: Command, block: Block) -> None:
        """Run a command and hold what it prints against the page."""
        small = block.run[0] == "small" or block.language == "before"
        command = replace(command, text=block.in_small(command.text) if small else command.text)
        where = f"{block.page.name}:{command.line}: {command.text}"
        if command.words == ["echo", "$?"]:
            assert command.output == [str(self.last)], f"{where}: it was {self.last}"
            return
        ran = self._ran(command, small)
        self.last = ran.code
        if not self.code_is_asked_for:
            assert ran.code in block.exits, f"{where} ended with {ran.code}:\n{ran.err}{ran.out}"
        if command.output:
            # a terminal shows both streams
            shown = (ran.out, ran.err + ran.out, ran.out + ran.err)
            found = [difference(command.output, text, ran.err, small=small) for text in shown]
            assert None in found, f"{where}: {found[0] if ran.code == 0 else found[1]}"

    def console(self, block: Block, commands: list[Command]) -> None:
        """Run the commands of a console; a failure is right where the next command asks for the exit code."""
        os.environ["COLUMNS"] = block.remarks.get("columns", str(COLUMNS))
        for command, following in zip(commands, [*commands[1:], None], strict=True):
            self.code_is_asked_for = following is not None and following.words == ["echo", "$?"]
            self.command(command, block)

    def _ran(self, command: Command, small: bool) -> Ran:
        words, text = command.words, command.text.partition(" #")[0]
        if SHELL.search(text):
            return self._piped(text) if PIPED.fullmatch(text) else self._shell(text)
        if words[0] != "lidardesign":
            return self._shell(text)
        if small and words[1] == "learn":
            return self._learned(words[1:])
        return in_process(words[1:])

    def _learned(self, words: list[str]) -> Ran:
        """A small run, copied where another page learned the same."""
        task = words[1]
        out = Path(words[words.index("--out") + 1]) if "--out" in words else Path("runs") / task
        asked = [word for word in words if word not in ("--out", str(out))]
        settings = [part for setting in SMALL[task] for part in ("--set", setting)]
        # what a page sets itself comes last and wins; files of a page are its own
        arguments = [*asked[:2], "--seed", str(shifted()), *settings, *asked[2:]]
        own_files = task in ("meshes", "mujoco") or "--config" in asked
        key = (*arguments, str(self.folder)) if own_files else tuple(arguments)
        if key not in self.library.known:
            ran = in_process([*arguments, "--out", str(out)])
            if ran.code == 0:
                kept = self.library.folder / str(len(self.library.known))
                shutil.copytree(out, kept)
                self.library.known[key] = kept, Ran(0, ran.out.replace(str(out), "{out}"), ran.err)
            return ran
        kept, ran = self.library.known[key]
        shutil.copytree(kept, out)
        return Ran(0, ran.out.replace("{out}", str(out)), ran.err)

    def _piped(self, text: str) -> Ran:
        """What commands do one after the other; the program in this process, as its start alone takes a second."""
        line, _, file = text.partition(">")
        given, said = None, ""
        for stage in line.split("|"):
            words = shlex.split(stage)
            ran = in_process(words[1:], given) if words[0] == "lidardesign" else self._shell(stage, given)
            given, said = ran.out, said + ran.err
        if file:
            (self.folder / file.strip()).write_text(given, encoding="utf-8")
        return Ran(ran.code, "" if file else given, said)

    def _shell(self, text: str, given: str | None = None) -> Ran:
        paths = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
        done = subprocess.run(
            ["bash", "-c", text], input=given, capture_output=True, text=True, check=False, cwd=self.folder,
            env={**os.environ, "PATH": paths},
        )  # fmt: skip
        return Ran(done.returncode, done.stdout, done.stderr)

    def _python(self, block: Block) -> None:
        text = SEED.sub(lambda seed: str(shifted(int(seed[0]))), block.text)
        code = compile("\n" * block.line + text, str(block.page), "exec")
        exec(code, self.names)


def in_process(arguments: list[str], given: str | None = None) -> Ran:
    """What the program does with some arguments, and maybe something on standard input, in this process."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    code: object = 0
    before = sys.stdin
    if given is not None:
        sys.stdin = io.TextIOWrapper(io.BytesIO(given.encode()), encoding="utf-8")
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            run_program([str(argument) for argument in arguments])
        except SystemExit as ended:
            code = ended.code
        finally:
            sys.stdin = before
    texts = (stream.buffer.getvalue().decode() for stream in (out, err))  # type: ignore[attr-defined]
    return Ran(code if isinstance(code, int) else 0, *texts)


def is_installed(name: str) -> bool:
    """Whether there is a program or a Python package of this name."""
    beside = Path(sys.executable).parent / name
    return beside.exists() or shutil.which(name) is not None or (name.isidentifier() and find_spec(name) is not None)
