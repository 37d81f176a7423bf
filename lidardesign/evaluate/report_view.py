"""The report's section with the 3D view: its switches, sliders and buttons, and the data that it is drawn from."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence

import numpy as np

from lidardesign.evaluate.curves import Series
from lidardesign.evaluate.drawing import MOST_FACES, drawn_share
from lidardesign.evaluate.report_parts import embedded, swatch, switch
from lidardesign.evaluate.scene_view import DASHES, MOST_BODIES, MOST_SENSORS, OUTCOMES, is_flat, view_document
from lidardesign.evaluate.shown import Shown, ShownDesign
from lidardesign.simulate.returns import Outcome

SCENE_ID = "view-scene"
DENSITY_COLOUR = "#7b2d8b"
CAMERA = (
    ("left", "Turn left"),
    ("right", "Turn right"),
    ("up", "Higher"),
    ("down", "Lower"),
    ("closer", "Closer"),
    ("farther", "Farther"),
    ("above", "From above"),
    ("reset", "First view"),
)

OF_SOLID = ("up", "down", "above")


def view_section(shown: Shown, looks: Sequence[Series], density_m: np.ndarray | None) -> str:
    """Everything of the view; `looks` are the designs' colours and dashes, `density_m` (K, 3) observed points."""
    document = view_document(shown, looks, density_m)
    stage = (
        f'<div class="stage"><div id="{SCENE_ID}" tabindex="0" role="application" aria-label="3D view of the scene. '
        'Arrow keys turn it, plus and minus go closer and farther, Home shows the first view."></div>'
        '<img id="view-printed" alt="The 3D view as it stood when the page was printed">'
        f"{_camera_buttons(is_flat(shown.directions))}</div>"
    )
    controls = "".join(
        (_sliders(shown), _outcomes(shown), _layers(shown, density_m is not None), _designs(shown, looks))
    )
    return (
        f"{''.join(f'<p>{html.escape(text)}</p>' for text in told(shown))}"
        f'<noscript><p class="note">The view needs JavaScript; all figures stand in the tables too.</p></noscript>'
        f'<div class="view">{stage}<div class="controls" role="group" aria-label="What is shown">{controls}</div></div>'
        f'<p id="view-status" role="status" aria-live="polite"></p>{embedded(document, id="view-data")}'
    )


def told(shown: Shown) -> list[str]:
    """Which scene is shown, how to read it, and what is left out."""
    how = (
        f"Held-out scene {shown.scene.name}. Lines run from where each ray starts to its first hit, or to the end of "
        "its gate; frusta are the sensors' fields of view, tinted shells their gates, ellipses where their rays start."
    )
    left_out = []
    if drawn_share(shown.scene) < 1:
        left_out.append(f"about {MOST_FACES:,} triangles of the meshes are drawn")
    if len(shown.scene.bodies) > MOST_BODIES:
        left_out.append(f"the largest {MOST_BODIES} of {len(shown.scene.bodies)} bodies are drawn")
    if len(shown.frames) < shown.scene.frames:
        left_out.append(f"{len(shown.frames)} of {shown.scene.frames} frames are shown")
    if len(shown.places) < shown.all_places:
        left_out.append(f"{len(shown.places)} of {shown.all_places} positions are shown")
    for one in shown.designs:
        if len(one.rays[0]) < one.fired:
            left_out.append(f"{len(one.rays[0])} of {one.fired} rays of {one.design.name} are drawn")
    reason = "the detector's effects decide what returns" if shown.physics else ""
    further = "; ".join([*left_out, *([reason] if reason else [])])
    return [how, *([further[0].upper() + further[1:] + "."] if further else [])]


def place_labels(shown: Shown) -> list[str]:
    """What each position is called."""
    return [", ".join(f"{name} = {value:.4g}" for name, value in place.items()) for place in shown.places]


def frame_labels(shown: Shown) -> list[str]:
    """What each frame is called."""
    rate_hz, frames = shown.scene.frame_rate_hz, shown.scene.frames
    return [f"frame {frame + 1} of {frames}, {frame / rate_hz:.2f} s" for frame in shown.frames]


def _camera_buttons(flat: bool) -> str:
    """What moves the camera; a world in a plane is always seen from above."""
    moves = [(how, word) for how, word in CAMERA if not (flat and how in OF_SOLID)]
    buttons = "".join(f'<button type="button" data-camera="{how}">{word}</button>' for how, word in moves)
    save = '<button type="button" id="view-save">Save picture</button>'
    return f'<div class="buttons" role="group" aria-label="Camera">{buttons}{save}</div>'


def _sliders(shown: Shown) -> str:
    """One slider over positions, one over frames, where there is more than one."""
    names = " and ".join(shown.places[0]) or "position"
    found = ""
    for step, title, labels in (
        ("place", f"Position: {names}", place_labels(shown)),
        ("frame", "Time", frame_labels(shown)),
    ):
        if len(labels) > 1:
            middle = len(labels) // 2
            named = html.escape(json.dumps(labels))
            found += (
                f'<div class="slider"><label for="view-{step}">{html.escape(title)}</label>'
                f'<output for="view-{step}"></output><input type="range" id="view-{step}" data-step="{step}" min="0" '
                f'max="{len(labels) - 1}" step="1" value="{middle}" data-labels="{named}"></div>'
            )
    return found


def _outcomes(shown: Shown) -> str:
    """One switch per outcome that any ray has, with the look of its rays and how many are drawn."""
    there = {int(code) for one in shown.designs for code in np.unique(one.outcome)} | {int(Outcome.RETURN)}
    switches = "".join(
        switch(name, picture=swatch(colour, dash, symbol), count=str(int(code)), outcome=str(int(code)))
        for code, name, colour, dash, symbol in OUTCOMES
        if int(code) in there
    )
    return _group("Rays", switches)


def _layers(shown: Shown, density: bool) -> str:
    occluders = any(not body.is_target for body in shown.scene.bodies)
    layers = [switch("scene", picture=swatch("#c9b8a8", None), layer="scene")]
    layers += [switch("occluders", picture=swatch("#6b7280", None), layer="occluders")] if occluders else []
    layers += [switch("fields of view", layer="fields"), switch("gates", layer="gates")]
    layers += [switch("where rays start", layer="starts")]
    if density:
        dots = swatch(DENSITY_COLOUR, "dotted")
        layers.append(switch("what the learned density observes", picture=dots, checked=False, layer="density"))
    return _group("Shown", "".join(layers))


def _designs(shown: Shown, looks: Sequence[Series]) -> str:
    """A switch per design, and one per sensor inside of it."""
    parts = []
    for number, (one, look) in enumerate(zip(shown.designs, looks, strict=True)):
        picture = swatch(look.colour, DASHES[look.dash])
        parts.append(switch(one.design.name, picture=picture, checked=number == 0, design=str(number)))
        parts.append(_sensors(one, number))
    return _group("Designs", "".join(parts)) if parts else ""


def _sensors(one: ShownDesign, number: int) -> str:
    sensors = one.design.sensors
    if len(sensors) > MOST_SENSORS:
        return f'<p class="sensors">{len(sensors)} sensors, drawn by their rays</p>'
    rays = np.bincount(one.rays[0].sensor, minlength=len(sensors))
    rows = "".join(
        switch(f"{sensor.name}: {count} {'ray' if count == 1 else 'rays'}", sensor=f"{number}.{index}")
        for index, (sensor, count) in enumerate(zip(sensors, rays, strict=False))
    )
    word = "sensor" if len(sensors) == 1 else "sensors"
    name = html.escape(one.design.name)
    buttons = "".join(
        f'<button type="button" data-every="{number}" data-to="{to}" aria-label="{label} sensors of {name}">{label}'
        "</button>"
        for to, label in (("on", "All"), ("off", "None"))
    )
    return (
        f'<details class="sensors"{" open" if number == 0 and len(sensors) <= 12 else ""}>'
        f"<summary>{len(sensors)} {word} of {name}</summary>"
        f'<div class="buttons">{buttons}</div>{rows}</details>'
    )


def _group(title: str, content: str) -> str:
    return f"<fieldset><legend>{html.escape(title)}</legend>{content}</fieldset>"
