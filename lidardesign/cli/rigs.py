"""Rigs of others beside a run: how far their rays are heard where no file says it, and how many they can fire."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lidardesign.errors import LidardesignError
from lidardesign.run.streams import is_input

if TYPE_CHECKING:
    from lidardesign.cli.console import Console
    from lidardesign.cli.runs import Run
    from lidardesign.design.sensor import Design


def reach_of(runs: Sequence[Run]) -> float | None:
    """How far any ray of the first run's design space may be heard [m]; None without a run."""
    from lidardesign.space import RANGE

    return runs[0].config.space.high[RANGE] if runs else None


def reach_beside(files: Iterable[Path], runs: Sequence[Run]) -> float | None:
    """How far rays may be heard in the first of the runs, or in that of the first design that came from one [m]."""
    from lidardesign.cli.runs import run_of
    from lidardesign.design.files import load_design

    if runs:
        return reach_of(runs)
    for path in files:
        if is_input(path):
            continue
        try:
            run = run_of(load_design(path), path)
        except LidardesignError:
            # whoever reads it for good says what is wrong with it
            continue
        if run is not None:
            return reach_of([run])
    return None


def tell_notes(design: Design, shown: str, console: Console) -> None:
    """Say what the file of a rig did not: only what was read from others has such notes."""
    notes = design.provenance.get("notes")
    if "source" in design.provenance and isinstance(notes, list):
        for note in notes:
            console.note(f"note: {shown}: {note}")


def budgets_within(designs: Iterable[Design], budgets: Sequence[int], console: Console) -> list[int]:
    """The numbers of rays to evaluate at where none is asked for: those that every fixed ray list has.

    Where a rig has fewer rays than the task's largest budget, its own number takes the place of those beyond it.
    """
    from lidardesign.design.rays import own_count

    fixed = {design.name: own_count(design) for design in designs if design.layout == "fixed"}
    usual = sorted(set(budgets))
    if not fixed or min(fixed.values()) >= usual[-1]:
        return usual
    name = min(fixed, key=lambda name: fixed[name])
    console.note(f"note: {name} fires {fixed[name]} rays: at equal rays no more are compared; --rays has other numbers")
    return sorted({*(count for count in usual if count <= fixed[name]), fixed[name]})
