"""The controls beside the view: what is shown, sensors and their limits, scores, and what is saved."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import viser

from lidardesign.constraints.document import SensorConstraints
from lidardesign.formats import FORMATS
from lidardesign.report.figures import OUTCOME_WORDS
from lidardesign.run.markup import rendered
from lidardesign.studio.choices import EVERY, MOUNT, Choices, SensorPose, constraint_keys, key_label
from lidardesign.studio.stage import COLOURS

NONE, ANY = "nothing", "sensors of any shape"
STEPS = ("Undo", "Redo", "Fit", "Stop", "Score")
SPLITS = {"training": "train", "held-out": "test"}
LIGHTS = {
    "as learned": (),
    "indoor, 300 lux": ("illuminance_lux=300", "light=indoor"),
    "cloudy, 10,000 lux": ("illuminance_lux=10000", "light=sun"),
    "sun, 100,000 lux": ("illuminance_lux=100000", "light=sun"),
}
DETECTORS = ("ideal", "single-photon", "consumer-8x8")
LAYERS = {
    "rays": "/design/rays", "returns": "/design/returns", "fields of view and gates": "/design/fields of view",
    "what is worth seeing (density)": "/density", "where sensors may be": "/places", "blind surface": "/blind",
}  # fmt: skip
DENSITY, BLIND = "what is worth seeing (density)", "blind surface"  # hidden at first
MODULE = "module-45x45-8x8"  # offered beside the parts of the catalogue; others are typed as a limit
TYPED_S = 1.0  # without a keystroke, after which what was typed counts
MOST_SENSORS, MOST_RAYS, WIDTH_PX = 12, 1000, 420


class ControlPanel:
    """The controls of a server; all its tabs show the same.

    Arguments:
        server: The server.
        choices: What they show first.
        designs, baselines: Names of those that can be shown.
        parts: Names of the parts in the catalogue.
        wish: Called with the name of every wish of a user and its value.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        choices: Choices,
        designs: Sequence[str],
        baselines: Sequence[str],
        parts: Sequence[str],
        wish: Callable[[str, Any], None],
    ) -> None:
        self.gui, self._wish = server.gui, wish
        self._fields: dict[str, Any] = {}
        self._typed: dict[int, object] = {}
        self.curves: Any = None
        self.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(WIDTH_PX)
        self.gui.set_panel_label(f"studio: {choices.run.folder.name}")
        self._input(self.gui.add_button_group("", STEPS), "step")
        self._status, self._working = self.gui.add_html(""), self.gui.add_html("")
        self.say_status(())
        self.say("")
        tabs = self.gui.add_tab_group()
        with tabs.add_tab("See"):
            self._see(choices, designs, baselines)
        with tabs.add_tab("Move"):
            self._move(choices, parts)
        with tabs.add_tab("Limits"):
            self._limits()
        self._scores_tab = tabs.add_tab("Scores")
        with self._scores_tab:
            self.scores = self.gui.add_markdown("Score judges the design and baselines on **held-out** scenes.")
        with tabs.add_tab("Save"):
            self._save()

    def say_status(self, lines: Sequence[str]) -> None:
        """Show what the design is and what it is worth."""
        self._status.content = _box(7.6, "".join(f"\n{line}" for line in lines[1:]), "".join(lines[:1]))

    def say(self, text: str, *, is_wrong: bool = False) -> None:
        """Show what is under way, or went wrong."""
        self._working.content = _box(4.6, text, colour="#b42318" if is_wrong else "#475467")

    def _input(self, control: Any, wish: str, key: str | None = None, *, waits: bool = False) -> Any:
        """A control whose changes by a user are wishes; those by the program are not.

        What is typed or slid waits until it is left alone: every keystroke is a change.
        """
        is_button = isinstance(control, viser.GuiButtonHandle | viser.GuiButtonGroupHandle)

        @control.on_click if is_button else control.on_update
        async def _(event: Any) -> None:
            if event.client is None:
                return
            if waits:
                self._typed[id(control)] = turn = object()
                await asyncio.sleep(TYPED_S)
                if self._typed.get(id(control)) is not turn:
                    return
                del self._typed[id(control)]
            value = getattr(event.target, "value", None)
            self._wish(wish, value if key is None else (key, value))

        return control

    def _give(self, control: Any, value: Any) -> None:
        """Give a control a value, unless someone types into it."""
        if control.value != value and id(control) not in self._typed:
            control.value = value

    def _offer(self, dropdown: Any, options: Sequence[str], value: str) -> None:
        """Give a dropdown options, of which one is chosen."""
        if [*dropdown.options] != [*options]:
            dropdown.options = [*options]
        self._give(dropdown, value if value in options else options[0])

    def _see(self, choices: Choices, designs: Sequence[str], baselines: Sequence[str]) -> None:
        gui, shown = self.gui, choices.design.name
        self.design = self._input(gui.add_dropdown("design", [*designs], initial_value=shown), "design")
        others = gui.add_dropdown("beside it", [NONE, *designs, *baselines], hint="drawn in blue, and compared")
        self.beside = self._input(others, "beside")
        self._input(gui.add_dropdown("scenes", [*SPLITS]), "look", "split")
        self.scene, self.frame = (
            self._input(gui.add_slider(name, min=0, max=1, step=1, initial_value=0), "look", name)
            for name in ("scene", "frame")
        )
        self._outcomes = gui.add_html("")
        with gui.add_folder("shown"):
            for name in LAYERS:
                self._input(gui.add_checkbox(name, initial_value=name not in (DENSITY, BLIND)), "layer", name)

    def _move(self, choices: Choices, parts: Sequence[str]) -> None:
        gui = self.gui
        count = gui.add_slider("number of sensors", min=1, max=MOST_SENSORS, step=1, initial_value=1)
        self.count = self._input(count, "count", waits=True)
        self.part = self._input(gui.add_dropdown("made of", [ANY, MODULE, *parts]), "part")
        self.handle = self._input(gui.add_dropdown("handle on", [NONE]), "handle")
        self._where = gui.add_html("")
        self.place, self.angles = (
            self._input(gui.add_text(label, initial_value=""), "pose", key, waits=True)
            for label, key in (("x, y, z [m]", "place_m"), ("azimuth, elevation, roll [deg]", "angles_deg"))
        )
        self.free = self._input(gui.add_button("Let the next fit place it again"), "free")

    def _limits(self) -> None:
        gui = self.gui
        gui.add_markdown("What the next **Fit** keeps to. Empty: no limit. **\\***: it limits the design.")
        rays = gui.add_slider("rays", min=1, max=MOST_RAYS, step=1, initial_value=1)
        self.rays = self._input(rays, "limit", "budget.rays", waits=True)
        self.detector = self._input(gui.add_dropdown("detector", DETECTORS), "detector")
        self.light = self._input(gui.add_dropdown("light", [*LIGHTS]), "light")
        self.scope = self._input(gui.add_dropdown("limits of", [EVERY]), "scope")
        sections: dict[str, list[str]] = {}
        for key in constraint_keys():
            sections.setdefault(key.split(".")[0], []).append(key)
        for section, keys in sections.items():
            with gui.add_folder(section.replace("_", " "), expand_by_default=False):
                for key in keys:
                    field = gui.add_text(key_label(key), initial_value="", hint=key)
                    self._fields[key] = self._input(field, "limit", key, waits=True)

    def _save(self) -> None:
        gui = self.gui
        self.name = self._input(gui.add_text("name", initial_value="studio"), "name", waits=True)
        self._input(gui.add_button("Save the design and its constraints"), "save")
        self._saved = gui.add_html(_box(4, ""))
        self.command = gui.add_text("the same from a shell", initial_value="", multiline=True)
        self.format = self._input(gui.add_dropdown("export as", ["choose a format", *FORMATS.names()]), "export")
        self._input(gui.add_button("Mounting page"), "mounts")

    def show(self, choices: Choices, handle: str, scope: str, counts: tuple[int, int]) -> None:
        """Bring every control in line with the choices.

        Arguments:
            choices: The choices.
            handle: What has the handle.
            scope: Whose limits are shown.
            counts: The number of scenes of the split, and of frames of the scene.
        """
        sensors, rays = choices.counts
        self._offer(self.handle, [NONE, *choices.poses], handle)
        self._offer(self.scope, [EVERY, *choices.names], scope)
        for slider, value, most in (
            (self.scene, choices.scene, counts[0] - 1),
            (self.frame, choices.frame, counts[1] - 1),
            (self.count, sensors, max(MOST_SENSORS, sensors)),
            (self.rays, rays, max(MOST_RAYS, rays)),
        ):
            slider.max, slider.disabled = max(most, 1), most < 1
            self._give(slider, value)
        part, *others = choices.constraints.get("parts", {}).get("names") or [ANY]
        self._give(self.part, part if part in self.part.options and not others else ANY)
        tight = choices.tight(scope)
        for key, field in self._fields.items():
            field.disabled = scope != EVERY and key.split(".")[0] not in SensorConstraints.model_fields
            field.label = key_label(key) + " *" * ({key, key.rpartition(".")[0]} & tight != set())
            self._give(field, "" if field.disabled else choices.value(key, scope))
        self._give(self.command, choices.command(self.name.value))

    def show_pose(self, choices: Choices, name: str, pose: SensorPose | None) -> None:
        """Show the numbers of what has the handle."""
        is_sensor = pose is not None and not name.startswith(MOUNT)
        self.place.disabled, self.angles.disabled = pose is None, not is_sensor
        self.free.disabled = not is_sensor or not choices.fixed(name)
        if pose is None:
            text = "Choose a sensor, or click its ball in the view; in training scenes it can be moved."
            self._where.content = _box(2.6, text)
            return
        words = {"origin": "place", "boresight": "direction"}
        fixed = " and ".join(words[key] for key in choices.fixed(name)) if is_sensor else "place"
        kept = f"fixed: {fixed}" if fixed else "the next fit may place it elsewhere"
        self._where.content = _box(2.6, f" in {choices.design.specification.frame}; {kept}", name)
        self._give(self.place, ", ".join(map(str, pose.place_m)))
        self._give(self.angles, ", ".join(map(str, pose.angles_deg)))

    def show_outcomes(self, codes: Sequence[int]) -> None:
        """Show how many rays come to which end, from the code of each."""
        counts = Counter(codes)
        outcomes = [(COLOURS[int(code)], counts[int(code)], word) for code, word in OUTCOME_WORDS.items()]
        self._outcomes.content = str(rendered("studio/templates/outcomes.html", rays=len(codes), outcomes=outcomes))

    def say_saved(self, text: str) -> None:
        """Show what was written."""
        self._saved.content = _box(4, text)

    def add_design(self, name: str) -> None:
        """Offer a design that was saved."""
        for dropdown in (self.design, self.beside):
            dropdown.options = [*dict.fromkeys([*dropdown.options, name])]

    def show_scores(self, text: str, figure: Any) -> None:
        """Show scores on held-out scenes, with their curves."""
        self.scores.content = str(text)  # viser sends no subclass of str
        if self.curves is None:
            with self._scores_tab:
                self.curves = self.gui.add_plotly(figure, aspect=1.2)
        else:
            self.curves.figure = figure


def _box(height_em: float, text: str, title: str = "", colour: str = "inherit") -> str:
    """A text of fixed height behind a bold title, so that the controls below it stay where they are."""
    box = rendered("studio/templates/box.html", height_em=height_em, text=text, title=title, colour=colour)
    return str(box)  # viser sends no subclass of str
