"""One word for how good a learned density is: good, usable or poor.

What matters is what designs lose by it. Rays are chosen among candidates that the density proposes, with a quarter of
even ones beside them, so a rough density costs little; benchmarks/verdicts.py measures how much.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

# The most of its mass in the wrong place, the largest KL [nats] and the least ESS of a density with this verdict.
BOUNDS: dict[str, tuple[float, float, float]] = {"good": (0.25, 0.5, 0.2), "usable": (0.5, 2.0, 0.05)}
NEXT = {"draft": "--preset standard learns longer", "standard": "--preset fine learns longer"}
LAST = "more learning.steps to a smaller learning.misplaced; a smaller space or a larger density.sigma_m learn faster"


@dataclass(frozen=True)
class Verdict:
    """What a density is worth.

    Arguments:
        word: good, usable or poor.
        why: The figure that keeps it from being better, and what that asks for; empty where it is good.
    """

    word: Literal["good", "usable", "poor"]
    why: str = ""

    @classmethod
    def of(cls, misplaced: float, kl_nats: float, ess: float) -> Verdict:
        """The verdict on a density with these figures."""
        reasons = {}
        for word, (most_misplaced, most_nats, least_ess) in BOUNDS.items():
            beyond = (
                (misplaced > most_misplaced, f"{misplaced:.2g} of its mass is in the wrong place", most_misplaced),
                (kl_nats > most_nats, f"KL is {kl_nats:.2g} nats", most_nats),
                (ess < least_ess, f"ESS is {ess:.2g}", least_ess),
            )
            reasons[word] = [f"{found} ({word}: {bound:g})" for wrong, found, bound in beyond if wrong]
        if not reasons["good"]:
            return cls("good")
        return cls("poor", reasons["usable"][0]) if reasons["usable"] else cls("usable", reasons["good"][0])

    def text(self, preset: str) -> str:
        """The verdict in a line, with what to do next for a density that was learned with a preset."""
        return f"{self.word}: {self.advice(preset)}" if self.why else self.word

    def advice(self, preset: str) -> str:
        """Why it is no better, and what to do next."""
        return f"{self.why}; {NEXT.get(preset, LAST)}"
