"""One HTML page about an evaluation: tables, curves, and the designs in a scene.

The page is one file that works offline and makes no network request: plotly is inside it, and its content
security policy forbids every connection. All names are escaped.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lidardesign.design.sensor import Design
from lidardesign.evaluate.drawing import MOST_FACES, drawn_share
from lidardesign.evaluate.figures import curve_figure, scene_figure
from lidardesign.evaluate.page import page
from lidardesign.evaluate.pareto_figure import accuracy_tables, pareto_figure, pareto_height_px
from lidardesign.evaluate.physics_tables import audit_section, effects_section
from lidardesign.evaluate.results import Evaluation
from lidardesign.evaluate.rungs import Ladder
from lidardesign.evaluate.verdicts import (
    bandwidth_table,
    paired_table,
    rows_table,
    sensors_table,
    summary_sentences,
)
from lidardesign.run.files import write_atomic
from lidardesign.scene import Scene
from lidardesign.simulate.returns import Rays

SCENE_ID, RAYS_ID, BANDWIDTH_ID = "view-scene", "curve-rays", "curve-bandwidth"
ACCURACY_ID = "accuracy"


def write_report(
    evaluation: Evaluation,
    designs: Sequence[Design],
    rays_by_design: Mapping[str, Rays],
    scene: Scene,
    path: Path,
    *,
    title: str | None = None,
    reproduce: Mapping[str, Any] | None = None,
    at: Mapping[str, float] | None = None,
) -> None:
    """Write the report, whole or not at all.

    Arguments:
        evaluation: What was found.
        designs: The designs to list and draw.
        rays_by_design: The rays to draw for each design, by name.
        scene: The scene to draw them in, at the frame in the middle of its time.
        path: The HTML file.
        title: The page's title; the metric's name by default.
        reproduce: Command, seed, versions and the like, shown as they are at the end.
        at: The condition values that designs and rays are drawn at.
    """
    write_atomic(Path(path), report_html(evaluation, designs, rays_by_design, scene, title, reproduce, at))


def report_html(
    evaluation: Evaluation,
    designs: Sequence[Design],
    rays_by_design: Mapping[str, Rays],
    scene: Scene,
    title: str | None = None,
    reproduce: Mapping[str, Any] | None = None,
    at: Mapping[str, float] | None = None,
) -> str:
    """The report as text; see `write_report`."""
    metric = evaluation.metric
    heading = title or f"{metric.name} on {evaluation.scenes} held-out scenes"
    frame = scene.frames // 2
    figure, masks = scene_figure(scene, designs, rays_by_design, frame)
    ladders = evaluation.accuracy.ladders if evaluation.accuracy else ()
    sections = [
        _section("Result", _paragraphs(summary_sentences(evaluation)) + _notes(evaluation.notes)),
        _section("Score against rays", _figure(curve_figure(evaluation, "rays"), RAYS_ID, 440)),
        _section(
            "Score against bandwidth", _figure(curve_figure(evaluation, "bandwidth"), BANDWIDTH_ID, 440)
        ),
        _section(
            "Designs in a scene",
            f"<p>{html.escape(_drawn(scene, frame, at or {}))} Lines run from where each ray starts to its first hit, "
            f"or to the end of its gate; tinted shells are the gates, ellipses where the rays of a sensor start.</p>"
            f"{_chooser(masks)}{_figure(figure, SCENE_ID, 560, tools=True)}",
        ),
        _section("All scores", rows_table(evaluation)),
        _section("Paired differences at equal rays", paired_table(evaluation)),
        _section("At equal bandwidth", bandwidth_table(evaluation)) if evaluation.equal_bandwidth else "",
        _section("Physics", effects_section(evaluation)) if evaluation.effects else "",
        _section("Audit of the physics", audit_section(evaluation, evaluation.audit)) if evaluation.audit else "",
        _section("What accuracy costs", _accuracy(ladders)) if ladders else "",
        *(_section(f"Sensors of {design.name}", sensors_table(design)) for design in designs),
        _section("How to reproduce", _definitions(reproduce)) if reproduce else "",
    ]
    return page(heading, "\n".join(section for section in sections if section), _plotly_source())


def _accuracy(ladders: Sequence[Ladder]) -> str:
    """The figure of all ladders, how to read it, and their tables."""
    read = (
        "Error against seconds on this machine, one panel per numerical choice. Orange is the cheapest setting inside "
        "the tolerance (dashed), a ring the one of this run; pale settings are beaten in both; triangles on the lower "
        "edge have no error to show, references among them."
    )
    height = pareto_height_px(ladders)
    picture = _figure(pareto_figure(ladders), ACCURACY_ID, height) if height else ""
    wide = f'<div class="scroll"><div class="panels">{picture}</div></div>'
    return f"<p>{read}</p>{wide}{accuracy_tables(ladders)}"


def _drawn(scene: Scene, frame: int, at: Mapping[str, float]) -> str:
    """Which scene is shown, and when and where it is seen."""
    shown = f"Held-out scene {scene.name}"
    if scene.frames > 1:
        shown += f", frame {frame + 1} of {scene.frames}"
    if at:
        shown += ", seen from " + ", ".join(f"{name}={value:g}" for name, value in at.items())
    if drawn_share(scene) < 1:
        shown += f" (drawn coarser: {MOST_FACES} of its triangles)"
    return f"{shown}."


def _plotly_source() -> str:
    from plotly.offline import get_plotlyjs

    return get_plotlyjs()


def _figure(figure: dict[str, Any], identifier: str, height_px: int, *, tools: bool = False) -> str:
    """A figure's division and script; plotly is loaded in the page's head, tools are buttons."""
    import plotly.graph_objects as go
    from plotly.io import to_html

    return to_html(
        go.Figure(figure),
        include_plotlyjs=False,
        full_html=False,
        div_id=identifier,
        default_width="100%",
        default_height=f"{height_px}px",
        config={
            "responsive": True,
            "displaylogo": False,
            "displayModeBar": tools,
            "plotlyServerURL": "",
            "showTips": False,
        },
    )


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{html.escape(heading)}</h2>\n{content}</section>"


def _paragraphs(sentences: Sequence[str]) -> str:
    return "".join(f"<p>{html.escape(sentence)}</p>" for sentence in sentences)


def _notes(notes: Sequence[str]) -> str:
    return "".join(f'<p class="note">{html.escape(note)}</p>' for note in notes)


def _definitions(values: Mapping[str, Any]) -> str:
    items = (
        f"<dt>{html.escape(str(key))}</dt><dd><code>{html.escape(str(value))}</code></dd>"
        for key, value in values.items()
    )
    return f"<dl>{''.join(items)}</dl>"


def _chooser(masks: Mapping[str, list[bool]]) -> str:
    """A list of the designs that shows one of them at a time; nothing to choose from where there is one."""
    if len(masks) < 2:
        return ""
    options = "".join(
        f'<option value="{index}">{html.escape(name)}</option>' for index, name in enumerate(masks)
    )
    return (
        f'<p><label>Design <select id="design-shown">{options}</select></label></p>'
        f"<script>const masks = {json.dumps(list(masks.values()))};"
        'document.getElementById("design-shown").addEventListener("change", event => '
        f'Plotly.restyle("{SCENE_ID}", {{visible: masks[event.target.value]}}));</script>'
    )
