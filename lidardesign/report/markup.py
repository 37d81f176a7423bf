"""The report's frame (head, style, scripts, a policy that forbids every connection) and small pieces of its markup.

Everything that comes from outside is escaped here or where it is put in.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

STROKES = {"solid": "", "dash": "6 3", "dashdot": "7 3 2 3", "dot": "2 3", "longdash": "11 4"}
# Characters of JSON that mean something to a reader of markup, and what stands for them.
ESCAPES = str.maketrans({"<": "\\u003c", ">": "\\u003e", "&": "\\u0026"})
# Marks of curves and of rays' ends, as closed shapes (filled) and strokes, about (0, 0) in a box of 8.
SHAPES = {
    "circle": "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0Z",
    "square": "M-4 -4H4V4H-4Z",
    "triangle-up": "M0 -4.5L4.5 3.5H-4.5Z",
    "triangle-down": "M0 4.5L4.5 -3.5H-4.5Z",
    "diamond": "M0 -5L5 0L0 5L-5 0Z",
    "cross": "M-1.5 -4.5H1.5V-1.5H4.5V1.5H1.5V4.5H-1.5V1.5H-4.5V-1.5H-1.5Z",
}
LINES = {
    "x-thin-open": "M-4 -4L4 4M-4 4L4 -4",
    "cross-thin-open": "M-4.5 0H4.5M0 -4.5V4.5",
    "asterisk-open": "M-4 -4L4 4M-4 4L4 -4M-4.5 0H4.5",
    "y-down-open": "M0 0V4.5M0 0L4 -3M0 0L-4 -3",
    "diamond-tall-open": "M0 -5L3.5 0L0 5L-3.5 0Z",
    "diamond-open": "M0 -5L5 0L0 5L-5 0Z",
    "square-open": "M-4 -4H4V4H-4Z",
}


def section(heading: str, content: str, identifier: str = "") -> str:
    """A section of the page with its heading, and a place to link to."""
    anchor = f' id="{identifier}"' if identifier else ""
    return f"<section{anchor}><h2>{html.escape(heading)}</h2>\n{content}</section>"


def paragraphs(sentences: Sequence[str], kind: str = "") -> str:
    """One paragraph per sentence."""
    mark = f' class="{kind}"' if kind else ""
    return "".join(f"<p{mark}>{html.escape(sentence)}</p>" for sentence in sentences)


def definitions(values: Sequence[tuple[str, str]]) -> str:
    """Names and values beside each other."""
    items = (f"<dt>{html.escape(name)}</dt><dd><code>{html.escape(value)}</code></dd>" for name, value in values)
    return f"<dl>{''.join(items)}</dl>"


def folded(summary: str, content: str, rows: int | None = None) -> str:
    """Content that unfolds below a summary with its number of rows; empty without content."""
    count = "" if rows is None else f" ({rows} {'row' if rows == 1 else 'rows'})"
    return f"<details><summary>{html.escape(summary)}{count}</summary>{content}</details>" if content else ""


def figure(document: dict[str, Any], identifier: str, height_px: int, caption: str, kind: str = "") -> str:
    """The container, caption and data of a plotly figure."""
    mark = f' class="{kind}"' if kind else ""
    name = html.escape(caption)
    return (
        f'<figure><div id="{identifier}"{mark} role="img" aria-label="{name}" style="height:{height_px}px"></div>'
        f"<figcaption>{name}</figcaption></figure>{embedded(document, data_figure=identifier)}"
    )


def embedded(document: Any, **attributes: str) -> str:
    """A document as a script of data, in which no text can end the script."""
    marks = "".join(f' {name.replace("_", "-")}="{html.escape(value)}"' for name, value in attributes.items())
    content = json.dumps(document, allow_nan=False).translate(ESCAPES)
    return f'<script type="application/json"{marks}>{content}</script>'


def encoded(values: np.ndarray, kind: str) -> str:
    """An array as base64 of its little-endian bytes, row by row."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def swatch(colour: str, dash: str | None, mark: str | None = None) -> str:
    """A legend sample of a line with its mark; without a dash a filled box."""
    width, height, middle = 34, 12, "translate(17.0 6.0)"
    if dash is None:
        drawn = f'<rect x="8" width="18" height="{height}" fill="{colour}"/>'
    else:
        strokes = f' stroke-dasharray="{STROKES[dash]}"' if STROKES[dash] else ""
        drawn = f'<line x2="{width}" y1="6" y2="6" stroke="{colour}" stroke-width="2.2"{strokes}/>'
    if mark in SHAPES:
        drawn += f'<path d="{SHAPES[mark]}" transform="{middle}" fill="{colour}"/>'
    elif mark in LINES:
        drawn += f'<path d="{LINES[mark]}" transform="{middle}" fill="none" stroke="{colour}" stroke-width="1.6"/>'
    return f'<svg width="{width}" height="{height}" aria-hidden="true">{drawn}</svg>'


def switch(label: str, *, picture: str = "", count: str = "", checked: bool = True, **data: str) -> str:
    """A checkbox with its label, a legend sample, and a place for a count."""
    marks = "".join(f' data-{name}="{html.escape(value)}"' for name, value in data.items())
    output = f'<output data-count="{html.escape(count)}"></output>' if count else ""
    return (
        f'<label class="switch"><input type="checkbox"{marks}{" checked" if checked else ""}>{picture}'
        f"<span>{html.escape(label)}</span>{output}</label>"
    )


# Nothing can be fetched or sent, and no text becomes a program.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; "
    "form-action 'none'"
)


def asset(name: str) -> str:
    """The text of a file of the page."""
    return files("lidardesign.report").joinpath("assets", name).read_text(encoding="utf-8")


def page(title: str, lead: str, body: str, plotly: str, links: Sequence[tuple[str, str]] = ()) -> str:
    """A whole page.

    Arguments:
        title: Its name.
        lead: The text under the title.
        body: Trusted markup.
        plotly: The source of plotly, a trusted script.
        links: Identifiers of sections and their headings.
    """
    name = html.escape(title)
    items = "".join(f'<li><a href="#{identifier}">{html.escape(heading)}</a></li>' for identifier, heading in links)
    sources = "".join(f"<script>{asset(name)}</script>\n" for name in ("scene.js", "paint.js", "view.js", "page.js"))
    # plotly is read by the last script, once the 3D view is drawn
    scripts = f'<script type="text/plain" id="plotly">{plotly}</script>\n{sources}'
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{name}</title>\n<style>{asset('report.css')}</style>\n</head>\n"
        '<body>\n<a class="skip" href="#content">Skip to the result</a>\n<main>\n'
        f"<header><h1>{name}</h1><p>{html.escape(lead)}</p>"
        f'<nav aria-label="Sections"><ul>{items}</ul></nav></header>\n<div id="content">\n{body}\n</div>\n</main>\n'
        # scripts come last, so that the text is there before them
        f"{scripts}</body>\n</html>\n"
    )
