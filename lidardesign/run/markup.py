"""HTML from templates, which are files beside the code that has their values, and numbers as people read them.

Whatever is put in is escaped, unless it comes from a template itself; a value that is missing is an error.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

TINY = 1e-4  # from here on the limit is shown


def rendered(template: str, **values: Any) -> Markup:
    """A template's text with its values.

    Arguments:
        template: Its path in the package, as `report/templates/page.html`.
        values: Plain values by the names that it has for them.
    """
    from markupsafe import Markup

    return Markup(_environment().get_template(template).render(values))


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("lidardesign", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"counted": counted, "digits": four_digits, "fixed": fixed, "plain": readable_number}
    environment.filters["formatted"] = format
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    return environment


def counted(number: int, noun: str) -> str:
    """A number with its noun, as "1 ray" or "2 rays"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def four_digits(value: float | None) -> str:
    """A number with four digits; a dash where there is none."""
    return "-" if value is None else f"{value:#.4g}".removesuffix(".")


def fixed(value: float, decimals: int) -> str:
    """A number with so many decimals, and no sign for a 0."""
    # adding zero takes the sign from a rounded -0
    return f"{round(float(value), decimals) + 0.0:.{decimals}f}"


def readable_number(value: float, digits: int, tiny: float = TINY) -> str:
    """A number of at least 0 without an exponent; below `tiny` as `<tiny`."""
    if 0 < value < tiny:
        return f"<{tiny:g}"
    rounded = float(f"{value:.{digits}g}")
    return f"{rounded:,.0f}" if rounded >= 10 ** (digits - 1) else f"{rounded:g}"
