"""At which numbers of rays which designs are evaluated: a fixed pattern fires no more rays than it has."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from lidardesign.design.sensor import Design
from lidardesign.errors import ConfigError


def pattern_size(design: Design) -> int | None:
    """The rays of a design's fixed pattern; None where a design can be laid out at any number."""
    return len(design.ray_table.sensor) if design.layout == "fixed" and design.ray_table is not None else None


def can_fire(design: Design, count: int) -> bool:
    """Whether a design has so many rays."""
    size = pattern_size(design)
    return size is None or count <= size


def usual_numbers(designs: Iterable[Design], budgets: Iterable[int]) -> list[int]:
    """The numbers to evaluate at where none is asked for: the task's, and those that smaller fixed patterns have."""
    usual = set(budgets)
    sizes = {size for size in map(pattern_size, designs) if size is not None}
    return sorted(usual | {size for size in sizes if size < max(usual)})


def fired_numbers(designs: Sequence[Design], counts: Iterable[int]) -> list[int]:
    """Those of some numbers of rays that any design can fire, in their order; all without a design.

    Raises:
        ConfigError: No design can fire any of them.
    """
    asked = list(dict.fromkeys(counts))
    kept = [count for count in asked if not designs or any(can_fire(design, count) for design in designs)]
    if asked and not kept:
        most = max(size for size in map(pattern_size, designs) if size is not None)
        raise ConfigError(
            f"no design fires {_listed(asked, 'or')} rays: all are fixed patterns",
            where="--rays",
            allowed=f"at most {most}",
            hint="a design of more parts: lidardesign catalog show NAME --rays N --out FILE",
        )
    return kept


def left_out(designs: Sequence[Design], counts: Iterable[int]) -> list[str]:
    """Which designs have no row at which numbers of rays, one line each, for people."""
    asked = sorted(set(counts))
    lines = []
    for design in designs:
        beyond = [count for count in asked if not can_fire(design, count)]
        if beyond:
            fires = f"{design.name} fires {pattern_size(design)} rays, its fixed pattern"
            lines.append(f"{fires}: it is left out at {_listed(beyond, 'and')} rays")
    empty = [count for count in asked if designs and not any(can_fire(design, count) for design in designs)]
    if empty:
        lines.append(f"no design fires {_listed(empty, 'or')} rays: nothing is evaluated there")
    return lines


def _listed(counts: Sequence[int], last: str) -> str:
    texts = [str(count) for count in counts]
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} {last} {texts[-1]}"
