"""The frame of the report's page: head, style, scripts, and a policy that forbids every connection."""

from __future__ import annotations

import html
from collections.abc import Sequence
from importlib.resources import files

# plotly compiles the functions that draw 3D at run time, hence unsafe-eval; nothing can be fetched or sent.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; "
    "img-src data: blob:; worker-src blob:; font-src data:; base-uri 'none'; form-action 'none'"
)
STYLE = "report.css"
SCRIPTS = ("scene.js", "page.js")


def asset(name: str) -> str:
    """The text of a file of the page."""
    return files("lidardesign.evaluate").joinpath("assets", name).read_text(encoding="utf-8")


def page(title: str, lead: str, body: str, plotly: str, links: Sequence[tuple[str, str]] = ()) -> str:
    """A whole page.

    Arguments:
        title: Its name.
        lead: What stands under it.
        body: Trusted markup.
        plotly: The source of plotly, a trusted script.
        links: Identifiers of sections and their headings.
    """
    name = html.escape(title)
    items = "".join(f'<li><a href="#{identifier}">{html.escape(heading)}</a></li>' for identifier, heading in links)
    scripts = "".join(f"<script>{source}</script>\n" for source in (plotly, *map(asset, SCRIPTS)))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{name}</title>\n<style>{asset(STYLE)}</style>\n</head>\n"
        '<body>\n<a class="skip" href="#content">Skip to the result</a>\n<main>\n'
        f"<header><h1>{name}</h1><p>{html.escape(lead)}</p>"
        f'<nav aria-label="Sections"><ul>{items}</ul></nav></header>\n<div id="content">\n{body}\n</div>\n</main>\n'
        # scripts come last, so that the text is there before them
        f"{scripts}</body>\n</html>\n"
    )
