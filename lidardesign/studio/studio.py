"""The studio of a run: what a user asks for changes the choices; workers draw, score and fit the newest of them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from lidardesign.api.design import Design
from lidardesign.api.run import FIXED_BASELINES
from lidardesign.api.training_scores import TrainingScores
from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError, LidardesignError
from lidardesign.estimates import Interval, figure_and_interval
from lidardesign.fitting.options import FitOptions
from lidardesign.formats.registry import EXPORTERS
from lidardesign.parts.catalogue import load_library
from lidardesign.report.figures import OUTCOME_WORDS
from lidardesign.run.clock import WAIT_S
from lidardesign.run.files import run_lock
from lidardesign.run.manifest import write_recorded
from lidardesign.run.yaml import dump_yaml
from lidardesign.run_folder import ignore
from lidardesign.samples import load_samples
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import observed_point
from lidardesign.studio.choices import EVERY, Choices, Pose
from lidardesign.studio.panel import ANY, DETECTORS, LAYERS, LIGHTS, NONE, SPLITS, STEPS, Panel
from lidardesign.studio.server import start_server, stop_server
from lidardesign.studio.stage import BESIDE, COLOURS, Stage
from lidardesign.task import random_generator

if TYPE_CHECKING:
    from lidardesign.api.run import Run
    from lidardesign.api.scores import Scores
    from lidardesign.clouds.seen import SeenScene
    from lidardesign.scenes.scene import Scene
    from lidardesign.task import Metric

DENSITY_POINTS = 3000
MOST_UNDONE = 100
NAME = "studio"  # of designs that are not saved yet
CONSTRAINTS = "constraints"  # the folder of constraint files in a run
SLIDERS = ("sensors", "rays")
END_S = 1.0  # for which what is under way is waited for


class StoppedError(Exception):
    """A user stopped what was under way."""


class Worker:
    """A thread that does the last thing asked for under each name; what waits under the same name is dropped.

    Arguments:
        name: Of the thread.
        failed: Called with what was raised.
    """

    def __init__(self, name: str, failed: Callable[[Exception], None]) -> None:
        self._waiting: dict[str, Callable[[], None]] = {}
        self._news, self._failed, self._ends = threading.Condition(), failed, False
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)
        self._thread.start()

    def ask(self, name: str, work: Callable[[], None]) -> None:
        """Have something done after what was asked for under other names."""
        with self._news:
            self._waiting.pop(name, None)
            self._waiting[name] = work
            self._news.notify()

    def drop(self) -> None:
        """Forget what waits."""
        with self._news:
            self._waiting.clear()

    def stop(self) -> None:
        """End the thread after what it does now, which is not waited for long."""
        with self._news:
            self._ends = True
            self._news.notify()
        self._thread.join(END_S)

    def _work(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting or self._ends)
                if self._ends:
                    return
                work = self._waiting.pop(next(iter(self._waiting)))
            try:
                work()
            except Exception as error:
                self._failed(error)


class Studio:
    """A page on which the sensors of a run are moved, fitted and scored, on this machine, until it is stopped.

    Arguments:
        run: The run.
        design: The design that is shown first; the run's last one by default, or a new one where it has none.
        port: The port to listen on; None: any that is free.

    Raises:
        ConfigError: The port is taken.

    Example:
        >>> studio = Studio(run)  # doctest: +SKIP
        >>> studio.address  # doctest: +SKIP
        'http://127.0.0.1:41233/YyC4...'
        >>> studio.stop()  # doctest: +SKIP
    """

    def __init__(self, run: Run, design: Design | None = None, port: int | None = None) -> None:
        self.run, self.saved = run, {one.name: one for one in run.designs()}
        first = design or next(reversed(self.saved.values()), None) or run.fit(name=NAME)
        self.choices = _loaded(run, first)
        self._ends_m = np.array([run.config.space.low[:3], run.config.space.high[:3]])  # of places of sensors
        self._before: list[Choices] = []
        self._after: list[Choices] = []
        self._beside: Design | None = None
        self._handle, self._scope, self._reference, self._last = NONE, EVERY, first, ""
        self._blind_is_shown, self._stops = False, threading.Event()
        self._scenes: dict[tuple[str, tuple[str, ...]], list[Scene]] = {}
        self._training: dict[tuple[str, tuple[str, ...]], TrainingScores] = {}
        self._ended = threading.Event()
        self._server, self._guard = start_server(port)
        self._page, self._answers = (Worker(f"studio {name}", self._failed) for name in ("page", "answers"))
        try:
            spec = first.specification
            self._stage = Stage(
                self._server, spec.frame, spec.mount is not None, partial(self.wish, "handle"), self._drag
            )
            names, parts = [*self.saved] or [first.name], load_library().names
            self._panel = Panel(self._server, self.choices, names, FIXED_BASELINES, parts, self.wish)
            for name in ("/density", "/blind"):
                self._stage.set_visible(name, False)
            self._refresh()
        except BaseException:
            self.stop()
            raise

    @property
    def address(self) -> str:
        """The page's address, with the token that lets a browser in."""
        return self._guard.address

    def stop(self) -> None:
        """End the page and its threads."""
        self._stops.set()
        for worker in (self._page, self._answers):
            worker.stop()
        stop_server(self._server)
        self._ended.set()

    def wait(self) -> None:
        """Wait until the page is stopped."""
        self._ended.wait()

    def _repr_html_(self) -> str:
        return f'<iframe src="{escape(self.address)}" width="100%" height="700" style="border:0"></iframe>'

    def wish(self, name: str, value: Any = None) -> None:
        """Do what a user asks for on the page: a control's name and its new value."""
        self._page.ask(f"{name} {value[0]}" if name in ("limit", "layer") else name, partial(self._do, name, value))

    def _do(self, name: str, value: Any) -> None:
        changed = getattr(self, f"_on_{name}")(value)
        if changed is None:
            self._show_controls()
        else:
            # a slider passes many values on its way
            self._change(changed, merges=name in SLIDERS and name == self._last)
        self._last = name

    def _change(self, choices: Choices, *, merges: bool = False) -> None:
        """Take over other choices; Undo goes back to those before, or before the last change where they merge."""
        if choices.design is not self.choices.design:
            self._reference = self.choices.design
        if not merges:
            self._before = [*self._before, self.choices][-MOST_UNDONE:]
        self.choices, self._after = choices, []
        self._refresh()

    # What is shown.

    def _refresh(self) -> None:
        """Draw the choices and ask for their score."""
        choices = self.choices
        with self._server.atomic():
            self._draw(choices.design, choices.detector)
            self._show_controls()
            self._show_handle()
        self._answers.ask("score", partial(self._score, choices, self._beside))
        if self._blind_is_shown:
            self._answers.ask("blind", partial(self._find_blind, choices))

    def _scenes_of(self, choices: Choices) -> list[Scene]:
        key = choices.split, choices.settings
        if key not in self._scenes:
            from lidardesign.config import with_task_settings

            run = self.run
            if choices.settings:
                run = replace(run, config=with_task_settings(run.task, run.config, choices.settings))
            self._scenes[key] = run.scenes(choices.split, run.config.seed)
        return self._scenes[key]

    def _seen(self, design: Design, choices: Choices, detector: str = "ideal") -> SeenScene:
        scene = self._scenes_of(choices)[choices.scene]
        return design.simulate([scene], detector=detector, settings=choices.settings, notes=ignore)[0]

    def _draw(self, design: Design, detector: str = "ideal") -> None:
        """Draw a design in the scene that is chosen."""
        choices = self.choices
        seen = self._seen(design, choices, detector)
        self._frames, self._mbps = len(seen.returns), mean_mbps([one.rays for one in seen.returns], Bandwidth())
        number = min(choices.frame, self._frames - 1)
        one = seen.returns[number]
        self._stage.show_scene(seen.scene, one.frame, [one.rays for one in seen.returns])
        self._stage.show_seen(seen, number)
        self._stage.show_sensors(design.specification.sensors, self._handle)
        self._stage.show_places(choices.mounts_m, self._boxes(choices))
        if self._beside is not None:
            beside = self._seen(self._beside, choices, detector)
            self._stage.show_seen(beside, min(number, len(beside.returns) - 1), "beside", BESIDE)
            self._stage.show_sensors(self._beside.specification.sensors, None, "beside", BESIDE)
        counts = Counter(one.outcome.tolist())
        words = [
            f'<span style="color:rgb{COLOURS[int(code)]}">&#9632;</span> {counts[int(code)]} {word}'
            for code, word in OUTCOME_WORDS.items()
            if counts[int(code)]
        ]
        self._panel.outcomes.content = f"{len(one.rays)} rays: {', '.join(words)}"

    def _boxes(self, choices: Choices) -> list[np.ndarray]:
        """The boxes that bound places: of the run, of the constraints, and those that are excluded."""
        (low, high), origin = self._ends_m, choices.constraints.get("origin", {})
        ends = [(low, high), (origin.get("low_m", low), origin.get("high_m", high))]
        ends += [(box["low_m"], box["high_m"]) for box in origin.get("exclude", ())]
        return [np.array(pair, dtype=np.float64) for pair in ends]

    def _show_controls(self) -> None:
        choices = self.choices
        counts = len(self._scenes_of(choices)), self._frames
        self._panel.show(choices, self._handle, self._scope, counts)

    def _show_handle(self) -> None:
        pose, free = self._pose(), np.less(*self._ends_m)
        is_sensor = not self._handle.startswith("mount ")
        self._stage.show_handle(pose, turns=is_sensor, free=free.tolist())
        self._show_pose(pose)

    def _show_pose(self, pose: Pose | None) -> None:
        is_sensor, number, fixed = not self._handle.startswith("mount "), self._number(), []
        each = self.choices.constraints.get("each") or []
        if is_sensor and number is not None and number < len(each):
            entry = each[number]
            fixed = [word for word, key in (("place", "origin"), ("boresight", "boresight")) if key in entry]
        frame = self.choices.design.specification.frame
        self._panel.show_pose(self._handle, pose, fixed, frame, turns=is_sensor)

    def _number(self) -> int | None:
        """The number of the sensor or mount that has the handle; None without one."""
        names = [sensor.name for sensor in self.choices.sensors]
        if self._handle in names:
            return names.index(self._handle)
        kind, _, number = self._handle.partition(" ")
        found = int(number) if kind == "mount" and number.isdecimal() else -1
        return found if 0 <= found < len(self.choices.mounts_m) else None

    def _pose(self) -> Pose | None:
        number = self._number()
        # held-out scenes are looked at, and nothing is placed by them
        if number is None or self.choices.split == "test":
            return None
        if self._handle.startswith("mount "):
            return Pose.of(self.choices.mounts_m[number], (0.0, 0.0, 0.0))
        return Pose.of_sensor(self.choices.sensors[number])

    # What a user asks for: each gives the changed choices, or None.

    def _drag(self, pose: Pose, ended: bool) -> None:
        self._page.ask("drag", partial(self._move, pose, ended))

    def _move(self, pose: Pose, ended: bool) -> None:
        """Let rays follow the handle; once it is let go, what has changed is fixed."""
        number, before = self._number(), self._pose()
        if number is None or before is None:
            return
        # what moves along a condition has no place of its own
        is_carried = bool(self.run.config.space.conditioned)
        place = before.place_m if is_carried else np.clip(pose.place_m, *self._ends_m)
        pose = Pose.of(place, pose.angles_deg)
        if pose == before:
            self._stage.place_handle(pose)
            return
        if self._handle.startswith("mount "):
            moved = self.choices.mount_moved(number, pose.place_m)
        else:
            moved = self.choices.moved(number, pose)
        if ended:
            self._change(moved)
            return
        with self._server.atomic():
            if moved.design is self.choices.design:
                self._stage.show_places(moved.mounts_m, self._boxes(moved))
            else:
                self._draw(moved.design)
            self._show_pose(pose)

    def _on_place(self, value: Any) -> None:
        pose = self._pose()
        if pose is not None:
            self._move(Pose.of(value, pose.angles_deg), True)

    def _on_angles(self, value: Any) -> None:
        pose = self._pose()
        if pose is not None and np.isfinite(value).all():
            azimuth, elevation, roll = value
            self._move(Pose.of(pose.place_m, (azimuth, min(max(elevation, -90.0), 90.0), roll)), True)

    def _on_free(self, _: Any) -> Choices | None:
        number = self._number()
        return None if number is None else self.choices.freed(number)

    def _on_handle(self, value: Any) -> None:
        self._handle = str(value)
        if self._number() is None:
            self._handle = NONE
        with self._server.atomic():
            self._stage.show_sensors(self.choices.sensors, self._handle)
            self._show_handle()

    def _on_design(self, value: Any) -> Choices | None:
        return _loaded(self.run, self.saved[value], self.choices) if value in self.saved else None

    def _on_beside(self, value: Any) -> None:
        self._stage.remove("/beside")
        self._beside = self.saved.get(value)
        if value in FIXED_BASELINES:
            self._answers.ask("baseline", partial(self._find_baseline, value, self.choices))
        self._refresh()

    def _on_split(self, value: Any) -> None:
        self._look(split=SPLITS.get(value, "train"), scene=0, frame=0)

    def _on_scene(self, value: Any) -> None:
        last = len(self._scenes_of(self.choices)) - 1
        self._look(scene=min(max(int(value), 0), last), frame=0)

    def _on_frame(self, value: Any) -> None:
        self._look(frame=min(max(int(value), 0), self._frames - 1))

    def _look(self, **place: Any) -> None:
        """Show another scene or frame, which changes nothing that could be undone."""
        self.choices = replace(self.choices, **place)
        self._refresh()

    def _on_layer(self, value: Any) -> None:
        name, is_shown = value
        self._stage.set_visible(LAYERS[name], bool(is_shown))
        if name == "blind surface":
            self._blind_is_shown = bool(is_shown)
            self._answers.ask("blind", partial(self._find_blind, self.choices))
        if name == "density":
            config = self.run.config
            samples = load_samples(self.run.folder, config.space)
            points = samples.resample(DENSITY_POINTS, random_generator(config.seed, "studio"))
            self._stage.show_density(observed_point(points))

    def _on_scope(self, value: Any) -> None:
        self._scope = str(value) if value in [sensor.name for sensor in self.choices.sensors] else EVERY

    def _on_sensors(self, value: Any) -> Choices:
        count = "parts.count" if "parts" in self.choices.constraints else "sensors.count"
        changed = self.choices.constrained(count, str(int(value)))
        each = list(changed.constraints.get("each") or ())[: int(value)]
        return replace(changed, constraints={**changed.constraints, **({"each": each} if each else {})})

    def _on_rays(self, value: Any) -> Choices:
        return self.choices.constrained("budget.rays", str(int(value)))

    def _on_part(self, value: Any) -> Choices | None:
        if value == ANY:
            return self.choices.constrained("parts", "")
        if value not in load_library().names:
            return None
        return self._made_of(value)

    def _on_module(self, value: Any) -> Choices:
        field, _, zones = str(value).strip().partition(" ")
        return self._made_of(f"module-{field}-{zones.strip()}") if value else self.choices.constrained("parts", "")

    def _made_of(self, name: str) -> Choices:
        from lidardesign.parts.catalogue import find_part

        _check_part_names([name])
        find_part(name)
        document = {key: value for key, value in self.choices.constraints.items() if key not in ("sensors", "budget")}
        document["parts"] = {"names": [name], "count": len(self.choices.sensors)}
        return replace(self.choices, constraints=Constraints.from_mapping(document).as_document(), state="changed")

    def _on_limit(self, value: Any) -> Choices:
        key, text = value
        changed = self.choices.constrained(key, str(text), self._scope)
        names = changed.constraints.get("parts", {}).get("names", ())
        _check_part_names([] if isinstance(names, str) else names)
        return changed

    def _on_detector(self, value: Any) -> Choices | None:
        return replace(self.choices, detector=value, state="changed") if value in DETECTORS else None

    def _on_light(self, value: Any) -> Choices | None:
        if value not in LIGHTS:
            return None
        scenes = replace(self.choices, settings=LIGHTS[value], state="changed")
        self._scenes_of(scenes)  # refused where the task has no light
        return scenes

    def _on_step(self, value: Any) -> None:
        if value in STEPS:
            steps = (self._undo, self._redo, self._fit, self._stop, self._score_held_out)
            steps[STEPS.index(value)]()

    def _on_name(self, _: Any) -> None:
        """The command line follows."""

    # Steps.

    def _undo(self) -> None:
        self._travel(self._before, self._after)

    def _redo(self) -> None:
        self._travel(self._after, self._before)

    def _travel(self, source: list[Choices], goal: list[Choices]) -> None:
        if source:
            goal.append(self.choices)
            self._reference, self.choices = self.choices.design, source.pop()
            self._refresh()

    def _stop(self) -> None:
        self._answers.drop()
        self._stops.set()

    def _fit(self) -> None:
        self._answers.ask("fit", partial(self._find_fit, self.choices))

    def _score_held_out(self) -> None:
        self._answers.ask("evaluate", partial(self._evaluate, self.choices))

    # Answers, which are found beside the page and shown where they are still asked for.

    def _step(self, label: str, *_: Any) -> None:
        """Show what is under way, or end it.

        Raises:
            StoppedError: The user stopped it.
        """
        if self._stops.is_set():
            raise StoppedError
        self._panel.working.content = f"{label} ..." if label else ""

    def _find_fit(self, choices: Choices) -> None:
        self._stops.clear()
        self._step("fitting")
        fit = self.run.fit if choices.base is None else choices.base.constrain
        remarks: list[str] = []
        design = fit(**choices.fit_arguments(NAME), progress=self._step, notes=remarks.append)
        self._page.ask("fitted", partial(self._take_fit, choices, design, remarks))

    def _take_fit(self, asked: Choices, design: Design, remarks: list[str]) -> None:
        self._panel.working.content = "  \n".join(map(str, remarks[-3:]))
        if self.choices.key == asked.key:
            self._change(replace(self.choices, design=design, state="fitted"))
        else:
            self._panel.working.content = "the choices have changed since: the fit is left out"

    def _find_baseline(self, name: str, choices: Choices) -> None:
        self._stops.clear()
        self._step(f"choosing the rays of {name}")
        found = self.run.baseline(name, rays=choices.design.usual_count(ignore))
        self._page.ask("found", partial(self._take_beside, found))

    def _take_beside(self, design: Design) -> None:
        self._panel.working.content = ""
        self._beside = design
        self._refresh()

    def _find_blind(self, choices: Choices) -> None:
        surface = self._seen(choices.design, choices).unseen() if self._blind_is_shown else None
        self._page.ask("blind", partial(self._stage.show_blind, *(surface or (np.zeros((0, 3)), np.zeros((0, 3))))))

    def _score(self, choices: Choices, beside: Design | None) -> None:
        key = choices.detector, choices.settings
        if key not in self._training:
            self._training[key] = TrainingScores(self.run, detector=choices.detector, settings=choices.settings)
        scores, metric = self._training[key], self.run.metric
        text = f"**{_figure(scores.score(choices.design), metric.unit)}** {metric.name}, {metric.better} is better, "
        text += f"on {len(scores.scenes)} training scenes that no fit chooses on"
        for name, other in (("before the last change", self._reference), (beside and beside.name, beside)):
            if other is not None and other is not choices.design:
                text += f"  \n{_compared(scores.difference(choices.design, other), metric)} than {name}"
        self._page.ask("scored", partial(self._show_status, choices, text))

    def _show_status(self, choices: Choices, text: str) -> None:
        if choices.design is not self.choices.design:
            return
        design, count = choices.design, choices.design.usual_count(ignore)
        state = "changed: press Fit" if choices.state == "changed" else f"as {choices.state}"
        sensors = f"{len(choices.sensors)} sensor{'s' * (len(choices.sensors) != 1)}"
        head = f"**{design.name}** ({state}): {sensors}, {count} rays, {self._mbps:.3g} Mbit/s"
        tight = sorted(choices.tight())
        further = f"  \ntight: {', '.join(tight)}" if tight else ""
        self._panel.status.content = f"{head}  \n{text}{further}"

    def _evaluate(self, choices: Choices) -> None:
        self._stops.clear()
        self._step("scoring on held-out scenes")
        designs, beside = [choices.design], self._beside
        if beside is not None and self.saved.get(beside.name) is beside and beside.name != choices.design.name:
            designs.append(beside)
        scores = self.run.evaluate(
            designs,
            rays=[choices.design.usual_count(ignore)],
            detector=choices.detector,
            settings=choices.settings,
            progress=lambda name, done, total: self._step(f"{name}: {done} of {total} held-out scenes"),
            notes=ignore,
        )
        self._page.ask("evaluated", partial(self._show_scores, scores))

    def _show_scores(self, scores: Scores) -> None:
        metric = self.run.metric
        rows = "\n".join(
            f"| {escape(row.design)} | {row.rays} | {row.bandwidth_mbps:.3g} | "
            f"{_figure(Interval(row.value, row.ci_low, row.ci_high), '')} |"
            for row in scores.rows
        )
        text = f"{scores.evaluation.scenes} **held-out** scenes, which nothing was chosen on; "
        text += f"{metric.better} is better.\n\n"
        text += f"| | rays | Mbit/s | {metric.name} [{metric.unit}] |\n|---|---|---|---|\n{rows}"
        self._panel.working.content = ""
        self._panel.show_scores(text, scores.figure("bandwidth"))

    # What is kept.

    def _on_save(self, _: Any) -> None:
        name, choices = str(self._panel.name.value).strip(), self.choices
        FitOptions(name=name)  # refuses what no design may be called
        if choices.state != "fitted":
            raise ConfigError("there is no fit of these choices yet", where="Save", hint="press Fit first")
        if self.run.design_path(name).exists():
            raise ConfigError(f"there is a design {name!r}", where="name", allowed="another name")
        design = Design(replace(choices.design.specification, name=name), self.run, None, choices.design.result)
        design.save()
        with run_lock(self.run.folder, wait_s=WAIT_S):
            write_recorded(self.run.folder, f"{CONSTRAINTS}/{name}.yaml", dump_yaml(dict(choices.constraints)).encode())
        self.saved[name] = design
        self._panel.add_design(name)
        self._panel.saved.content = f"saved {design.path} and {self.run.folder / CONSTRAINTS / name}.yaml"

    def _on_export(self, _: Any) -> None:
        self._export(str(self._panel.format.value))

    def _on_mounts(self, _: Any) -> None:
        self._export("mounts")

    def _export(self, name: str) -> None:
        design = self.saved.get(str(self._panel.name.value).strip())
        if design is None or name not in EXPORTERS:
            raise ConfigError("only saved designs are exported", where="Export", hint="press Save first")
        exported = design.export(format=name, notes=ignore)
        self._panel.saved.content = f"wrote {exported.path}"

    def _failed(self, error: Exception) -> None:
        """Show what went wrong; the page goes on."""
        if isinstance(error, StoppedError):
            self._panel.working.content = "stopped"
            return
        is_known = isinstance(error, LidardesignError)
        title = "This cannot be done" if is_known else "This is a bug"
        body = str(error) if is_known else f"{type(error).__name__}: {error}"
        # a tab that is opened later shows it, too
        self._panel.working.content = f"**{title}**\n```\n{body}\n```"
        for client in self._server.get_clients().values():
            client.add_notification(title, body, color="red")
        self._show_controls()


def _loaded(run: Run, design: Design, shown: Choices | None = None) -> Choices:
    """The choices with a design and its constraints; it is fitted again where it is saved in the run."""
    base = design if design.path is not None else None
    constraints = Constraints.from_mapping(design.specification.constraints).as_document()
    if shown is None:
        return Choices(run, design, constraints, base)
    return replace(shown, design=design, constraints=constraints, base=base, state="saved")


def _check_part_names(names: list[str]) -> None:
    """Refuse paths of part files: the page opens no files.

    Raises:
        ConfigError: There is one.
    """
    for name in names:
        if "/" in name or "\\" in name or name.endswith(".yaml"):
            raise ConfigError(f"{name!r} is a path", where="parts.names", allowed="names of parts in the catalogue")


def _figure(interval: Interval, unit: str, word: str = "") -> str:
    value, low, high = figure_and_interval(interval.mean, interval.low, interval.high)
    ends = "" if interval.low is None else f" ({low} to {high})"
    return " ".join(filter(None, (value, unit, word))) + ends


def _compared(difference: Interval, metric: Metric) -> str:
    """A difference of scores, as `0.3 mm better (0.1 to 0.5)`."""
    is_better = (difference.mean < 0) == (metric.better == "lower")
    if difference.mean < 0:
        ends = [None if end is None else -end for end in (difference.high, difference.low)]
        difference = Interval(-difference.mean, *ends)
    return (
        _figure(difference, metric.unit, "better" if is_better else "worse")
        if difference.mean
        else "no better or worse"
    )
