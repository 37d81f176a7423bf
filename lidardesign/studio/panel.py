"""The controls beside the view: what is shown, sensors and their limits, scores, and what is saved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import viser

from lidardesign.formats.registry import EXPORTERS
from lidardesign.studio.choices import EVERY, Choices, Pose, constraint_keys, is_per_sensor, key_label

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
    "density": "/density", "places": "/places", "blind surface": "/blind",
}  # fmt: skip
MODULE = "module-"
HIDDEN = ("density", "blind surface")  # at first
MOST_SENSORS, WIDTH_PX = 12, 420
# Called with what was asked for and its value; None of a button without one.
Ask = Callable[[str, Any], None]


class Panel:
    """The controls of a server; all its tabs show the same.

    Arguments:
        gui: The server's controls.
        choices: What they show first.
        designs, baselines: Names of those that can be shown.
        parts: Names of the parts in the catalogue.
        ask: Called with every wish of a user: its name and its value.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        choices: Choices,
        designs: Sequence[str],
        baselines: Sequence[str],
        parts: Sequence[str],
        ask: Ask,
    ) -> None:
        self.gui, self._ask = server.gui, ask
        self._fields: dict[str, Any] = {}
        self.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(WIDTH_PX)
        self.gui.set_panel_label(f"studio: {choices.run.folder.name}")
        self.status = self.gui.add_markdown("")
        self.steps = self._input(self.gui.add_button_group("", STEPS), "step")
        self.working = self.gui.add_markdown("")
        tabs = self.gui.add_tab_group()
        with tabs.add_tab("See"):
            self._see(choices, designs, baselines)
        with tabs.add_tab("Move"):
            self._move(choices, parts)
        with tabs.add_tab("Limits"):
            self._limits(choices)
        self._scores_tab = tabs.add_tab("Scores")
        with self._scores_tab:
            self.scores = self.gui.add_markdown("Score judges the design and baselines on **held-out** scenes.")
            self.curves: Any = None
        with tabs.add_tab("Save"):
            self._save()

    def _input(self, handle: Any, wish: str) -> Any:
        """A control whose changes by a user are asked for; those by the program are not."""

        @handle.on_click if isinstance(handle, viser.GuiButtonHandle | viser.GuiButtonGroupHandle) else handle.on_update
        async def _(event: Any) -> None:
            if event.client is not None:
                self._ask(wish, getattr(event.target, "value", None))

        return handle

    def _see(self, choices: Choices, designs: Sequence[str], baselines: Sequence[str]) -> None:
        gui, shown = self.gui, choices.design.name
        self.design = self._input(
            gui.add_dropdown("design", [*designs], initial_value=shown if shown in designs else designs[0]), "design"
        )
        self.beside = self._input(
            gui.add_dropdown(
                "beside it", [NONE, *designs, *baselines], initial_value=NONE, hint="drawn in blue, and compared"
            ),
            "beside",
        )
        self.split = self._input(gui.add_dropdown("scenes", [*SPLITS], initial_value="training"), "split")
        self.scene = self._input(gui.add_slider("scene", 0, 1, 1, 0), "scene")
        self.frame = self._input(gui.add_slider("frame", 0, 1, 1, 0), "frame")
        self.outcomes = gui.add_html("")
        with gui.add_folder("shown"):
            for name in LAYERS:
                box = gui.add_checkbox(name, name not in HIDDEN)

                @box.on_update
                async def _(event: Any, name: str = name) -> None:
                    if event.client is not None:
                        self._ask("layer", (name, event.target.value))

    def _move(self, choices: Choices, parts: Sequence[str]) -> None:
        gui = self.gui
        self.sensors = self._input(
            gui.add_slider("number of sensors", 1, MOST_SENSORS, 1, len(choices.sensors)), "sensors"
        )
        self.part = self._input(
            gui.add_dropdown("made of", [ANY, *parts], initial_value=ANY, hint="a part of the catalogue"), "part"
        )
        self.module = self._input(
            gui.add_text("or module", "", hint="field of view and zones of your own module, as 45x45 8x8"), "module"
        )
        self.handle = self._input(gui.add_dropdown("handle on", [NONE], initial_value=NONE), "handle")
        self.where = gui.add_markdown("")
        self.place = self._input(gui.add_vector3("x, y, z [m]", (0.0, 0.0, 0.0), step=0.001, disabled=True), "place")
        self.angles = self._input(
            gui.add_vector3("azimuth, elevation, roll [deg]", (0.0, 0.0, 0.0), step=0.1, disabled=True), "angles"
        )
        self.fixed = gui.add_markdown("")
        self.free = self._input(gui.add_button("Let the next fit place it again", disabled=True), "free")

    def _limits(self, choices: Choices) -> None:
        gui = self.gui
        gui.add_markdown("What the next **Fit** keeps to. Empty: no limit. **\\***: it limits the design.")
        self.rays = self._input(gui.add_slider("rays", 1, 1000, 1, 100), "rays")
        self.detector = self._input(gui.add_dropdown("detector", DETECTORS, initial_value="ideal"), "detector")
        self.light = self._input(gui.add_dropdown("light", [*LIGHTS], initial_value="as learned"), "light")
        self.scope = self._input(gui.add_dropdown("limits of", [EVERY], initial_value=EVERY), "scope")
        sections: dict[str, list[str]] = {}
        for key in constraint_keys():
            sections.setdefault(key.split(".")[0], []).append(key)
        for section, keys in sections.items():
            with gui.add_folder(section.replace("_", " "), expand_by_default=False):
                for key in keys:
                    field = gui.add_text(key_label(key), choices.value(key), hint=key)
                    self._fields[key] = field

                    @field.on_update
                    async def _(event: Any, key: str = key) -> None:
                        if event.client is not None:
                            self._ask("limit", (key, event.target.value))

    def _save(self) -> None:
        gui = self.gui
        self.name = self._input(gui.add_text("name", "studio"), "name")
        self._input(gui.add_button("Save the design and its constraints"), "save")
        self.saved = gui.add_markdown("")
        gui.add_markdown("The same from a shell:")
        self.command = gui.add_text("command", "", multiline=True)
        self.format = gui.add_dropdown("format", [*EXPORTERS], initial_value="csv")
        self._input(gui.add_button("Export"), "export")
        self._input(gui.add_button("Mounting page"), "mounts")

    def show(self, choices: Choices, handle: str, scope: str, counts: tuple[int, int]) -> None:
        """Bring every control in line with the choices.

        Arguments:
            choices: The choices.
            handle: What has the handle.
            scope: Whose limits are shown.
            counts: The number of scenes of the split, and of frames of the scene.
        """
        names = [sensor.name for sensor in choices.sensors]
        mounts = [f"mount {number}" for number in range(len(choices.mounts_m))]
        _offer(self.handle, [NONE, *names, *mounts], handle)
        _offer(self.scope, [EVERY, *names], scope)
        for slider, value, count in ((self.scene, choices.scene, counts[0]), (self.frame, choices.frame, counts[1])):
            slider.max, slider.disabled = max(count - 1, 1), count < 2
            _give(slider, value)
        self.sensors.max = max(MOST_SENSORS, len(names))
        _give(self.sensors, len(names))
        rays = choices.design.specification.count or 0
        self.rays.max = max(1000, rays)
        _give(self.rays, max(rays, 1))
        names = choices.constraints.get("parts", {}).get("names", ())
        part = names[0] if len(names) == 1 else ANY
        _give(self.part, part if part in self.part.options else ANY)
        _give(self.module, " ".join(part.removeprefix(MODULE).rsplit("-", 1)) if part.startswith(MODULE) else "")
        tight = choices.tight(scope)
        for key, field in self._fields.items():
            own = scope == EVERY or is_per_sensor(key)
            field.disabled = not own
            field.label = key_label(key) + (" *" if key in tight or key.rpartition(".")[0] in tight else "")
            _give(field, choices.value(key, scope) if own else "")
        self.command.value = choices.command(self.name.value)

    def show_pose(self, name: str, pose: Pose | None, fixed: Sequence[str], frame: str, *, turns: bool) -> None:
        """Show the numbers of what has the handle."""
        is_sensor = pose is not None and turns
        self.place.disabled, self.angles.disabled, self.free.disabled = pose is None, not is_sensor, not is_sensor
        if pose is None:
            self.where.content = "Choose a sensor, or click its ball in the view; in training scenes it can be moved."
            self.fixed.content = ""
            return
        self.where.content = f"**{name}** in {frame}"
        _give(self.place, pose.place_m)
        _give(self.angles, pose.angles_deg)
        kept = " and ".join(fixed)
        self.fixed.content = f"fixed: {kept}" if kept else "the next fit may place it elsewhere"

    def add_design(self, name: str) -> None:
        """Offer a design that was saved."""
        for dropdown in (self.design, self.beside):
            dropdown.options = [*dict.fromkeys([*dropdown.options, name])]

    def show_scores(self, text: str, figure: Any) -> None:
        """Show scores on held-out scenes, with their curves."""
        self.scores.content = text
        if self.curves is None:
            with self._scores_tab:
                self.curves = self.gui.add_plotly(figure, aspect=1.2)
        else:
            self.curves.figure = figure


def _offer(dropdown: Any, options: Sequence[str], value: str) -> None:
    """Give a dropdown options, of which one is chosen."""
    if [*dropdown.options] != [*options]:
        dropdown.options = [*options]
    _give(dropdown, value if value in options else options[0])


def _give(control: Any, value: Any) -> None:
    if control.value != value:
        control.value = value
