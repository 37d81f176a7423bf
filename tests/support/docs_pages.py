"""The pages of the documentation as the tests run them: blocks of commands, their outputs, and the files they show.

A comment above a block, which readers of the page do not see, may say how the tests treat it:

    <!-- run: small -->           learn with the small settings of `docs_session.SMALL`
    <!-- instead: A => B; ... --> in a small run, B stands for A in the block's commands
    <!-- run: not, REASON -->     not run: its commands are parsed only
    <!-- run: if NAME, ... -->    run where a program or a Python package of this name is installed
    <!-- exits: 0, 1 -->          its commands may end with these codes, where that hangs on numbers
    <!-- columns: N -->          a terminal of another width
    <!-- file: NAME -->           the block is a file of this name
    <!-- before: COMMAND -->      a command that this page takes as done, run without being shown

A block whose first line is a comment with a file's name is that file too.
"""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
# What was found is told there, as reports of long runs: their commands are those of the Makefile and of benchmarks.
REPORTS = {"benchmarks.md"}
PAGES = sorted(
    [ROOT / "README.md", *(page for page in (ROOT / "docs").glob("*.md") if page.name not in REPORTS)],
    key=lambda page: (page.name != "README.md", str(page)),
)
BLOCK = re.compile(
    r"(?P<comments>(?:<!--(?:(?!-->).)*-->\s*)*)^```(?P<language>\w+)\n(?P<text>.*?)^```$|<!--\s*(?P<alone>before:.*?)\s*-->",
    re.MULTILINE | re.DOTALL,
)
COMMENT = re.compile(r"<!--\s*(\w+):\s*(.*?)\s*-->", re.DOTALL)
NAMED = re.compile(r"^(?:#|//|<!--)\s*([\w./-]+\.(?:yaml|py|toml|csv|xml|json|sh))\b")
PROMPT = "$ "


@dataclass
class Command:
    """One command of a console and what the page says that it prints."""

    text: str
    line: int
    output: list[str] = field(default_factory=list)

    @property
    def words(self) -> list[str]:
        """The command without the remark behind it."""
        return shlex.split(self.text.replace("\\\n", " "), comments=True)


@dataclass
class Block:
    """A block of a page: its language, its text, and what the comments above it say."""

    page: Path
    line: int
    language: str
    text: str
    remarks: dict[str, str]

    @property
    def run(self) -> tuple[str, str]:
        """How it is run, and with what: ("", "") as it stands."""
        kind, _, rest = self.remarks.get("run", "").partition(" ")
        return kind.rstrip(","), rest.strip()

    @property
    def exits(self) -> set[int]:
        """The codes that its commands may end with."""
        return {int(code) for code in self.remarks.get("exits", "0").split(",")}

    def in_small(self, command: str) -> str:
        """A command with what stands in it in a small run."""
        for pair in filter(None, self.remarks.get("instead", "").split("; ")):
            shown, instead = pair.split(" => ")
            command = command.replace(shown, instead)
        return command

    @property
    def file(self) -> str | None:
        """The name of the file that it shows."""
        if "file" in self.remarks:
            return self.remarks["file"]
        found = NAMED.match(self.text)
        return found.group(1) if found and self.language != "console" else None

    @property
    def where(self) -> str:
        """Page and line, for messages."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks_of(page: Path) -> list[Block]:
    """The blocks of a page in order; commands that are taken as done are blocks of the language `before`."""
    text, found = page.read_text(encoding="utf-8"), []
    for match in BLOCK.finditer(text):
        if match["alone"]:
            line = text[: match.start()].count("\n") + 1
            found.append(Block(page, line, "before", match["alone"].removeprefix("before:").strip(), {}))
            continue
        start = match.start("language")
        remarks = []
        for kind, value in COMMENT.findall(match["comments"]):
            if kind == "before":
                found.append(Block(page, text[: match.start()].count("\n") + 1, "before", value, {}))
            else:
                remarks.append((kind, " ".join(value.split())))
        line = text[:start].count("\n") + 1
        found.append(Block(page, line, match["language"], match["text"], dict(remarks)))
    return found


def commands_of(block: Block) -> list[Command]:
    """The commands of a console block with the output under each; a backslash goes on on the next line."""
    if block.language == "before":
        return [Command(block.text, block.line)]
    if block.language == "sh":  # of the command reference: no prompts and no outputs
        numbered = enumerate(block.text.splitlines(), block.line + 1)
        return [Command(line, number) for number, line in numbered if not line.startswith("#")]
    commands: list[Command] = []
    going_on = False
    for number, line in enumerate(block.text.splitlines(), block.line + 1):
        if going_on:
            commands[-1].text += f"\n{line}"
        elif line.startswith(PROMPT):
            commands.append(Command(line.removeprefix(PROMPT), number))
        else:
            assert commands, f"{block.where}: a console block begins with a command"
            commands[-1].output.append(line)
        going_on = line.endswith("\\") and (going_on or line.startswith(PROMPT))
    return commands
