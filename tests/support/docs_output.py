"""Whether a command printed what a page says: the same words, columns and file names, with any numbers."""

from __future__ import annotations

import re

BOXES = re.compile(r"[\u2500-\u257f]+")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?|\d+")
LEFT_OUT = "..."
NOTE = "note: "
# Every command that computes says its time in a line, or with -v in a table; pages that are not about it leave it out.
TOOK = re.compile(r"took [\w. ]+ s")
TIMES = "where the time went"
# What a comparison of numbers may turn out to be.
VERDICTS = re.compile(r"\b(?:better|worse|not told apart|yes, tight|yes|no)\b")
# Lines and words that follow from the numbers alone: which baseline is the strongest, which constraint is tight.
VARYING = re.compile(
    r"tight: |no constraint is tight|the constraints leave |.*the strongest baseline on training scenes"
)
BASELINE = re.compile(r"\bdifference to \w+")
BASELINE_ROW = re.compile(r"\b(?:uniform|random|bounding|silhouette|greedy) (?=# )")
# Said only where the numbers ask for it.
OCCASIONAL = re.compile(r", # rays in all(?=:)|, rays #$|<(?=#)| \(# %\)(?= verdict)")


def masked(text: str) -> str:
    """The words of a text in one line, without the lines of tables, a # for every number."""
    words = " ".join(NUMBER.sub("#", BOXES.sub(" ", text)).split())
    words = BASELINE_ROW.sub("baseline ", BASELINE.sub("difference to it", VERDICTS.sub("verdict", words)))
    return OCCASIONAL.sub("", words)


def difference(expected: list[str], out: str, err: str, *, small: bool) -> str | None:
    """What a page says and a command did not print, or the other way round; None where they agree.

    A line of three dots stands for any lines. Notes may come on either stream. A small run may have notes more.
    """
    notes = [masked(line) for line in (*err.splitlines(), *out.splitlines()) if line.startswith(NOTE)]
    for line in expected:
        if line.startswith(NOTE) and masked(line) not in notes:
            return f"this note was not given: {line}\nbut: {notes}"
    shown = [line for line in expected if not (line.startswith(NOTE) or VARYING.match(line))]
    if not any(line.startswith(TIMES) for line in shown):
        out = out.partition(TIMES)[0]
    printed = [line for line in out.splitlines() if not VARYING.match(line)]
    printed = [line for line in printed if not (line.startswith(NOTE) and (small or line in expected))]
    if not any(TOOK.fullmatch(line) for line in shown):
        printed = [line for line in printed if not TOOK.fullmatch(line)]
    # a note that the page shows is no longer among what is compared in order
    printed = [line for line in printed if not line.startswith(NOTE) or masked(line) not in map(masked, expected)]
    return _mismatch(_pieces(shown), masked("\n".join(printed)))


def _pieces(lines: list[str]) -> list[str]:
    """The masked text between the places where lines are left out."""
    pieces: list[list[str]] = [[]]
    for line in lines:
        if line.strip() == LEFT_OUT:
            pieces.append([])
        else:
            pieces[-1].append(line)
    return [masked("\n".join(piece)) for piece in pieces]


def _mismatch(pieces: list[str], printed: str) -> str | None:
    if re.fullmatch(".*".join(map(re.escape, pieces)), printed, re.DOTALL):
        return None
    return f"the page says\n  {' ... '.join(pieces)}\nbut this was printed\n  {printed}"
