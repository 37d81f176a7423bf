"""The studio of a run: what a user asks for changes the choices; workers draw, score and fit the newest of them."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import replace
from functools import cache, lru_cache, partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np

from lidardesign.api.design import Design
from lidardesign.api.run import Run, fixed_methods
from lidardesign.api.scores import Scores
from lidardesign.clouds.seen import Measuring, SeenScene
from lidardesign.constraints.origins import SAME_PLACE_M, place_text
from lidardesign.errors import BackgroundNote, ConfigError, LidardesignError
from lidardesign.estimates import Interval, comparison, figure_and_interval, mean_interval, paired_difference
from lidardesign.fitting.options import check_name
from lidardesign.formats import FORMATS
from lidardesign.parts.catalogue import load_library
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.run.manifest import locked_run, write_recorded
from lidardesign.run.markup import rendered
from lidardesign.run.yaml import dump_yaml
from lidardesign.run_folder import ignore
from lidardesign.samples import load_samples
from lidardesign.scenes.scene import Scene, group_numbers
from lidardesign.scoring.fired import fired
from lidardesign.scoring.scene_scores import Preparation, TrainingScorer
from lidardesign.sensors.adaptive import mean_mbps
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.space import observed_point
from lidardesign.studio.choices import EVERY, MOUNT, Choices, SensorPose
from lidardesign.studio.panel import BLIND, DENSITY, LAYERS, LIGHTS, NONE, SPLITS, STEPS, ControlPanel
from lidardesign.studio.server import Worker, start_server, stop_server
from lidardesign.studio.stage import BESIDE, Stage
from lidardesign.task import random_generator

DENSITY_POINTS = 3000
MOST_UNDONE = 100
PURPOSE = "comparison"  # of the stream of training scenes: fits choose and hold back scenes of other streams
SCENES = 20
MOST_KEPT = 100  # designs whose scores are known
NAME = "studio"  # of designs that are not saved yet
CONSTRAINTS = "constraints"  # the folder of constraint files in a run


class StoppedError(Exception):
    """A user stopped what was under way."""


class Studio:
    """A page on which the sensors of a run are moved, fitted and scored, on this machine, until it is stopped.

    Arguments:
        run: The run.
        design: The design that is shown first; the run's last one by default, or a new one where it has none.
        port: The port to listen on; None: any that is free.

    Raises:
        ConfigError: The port is taken.
    """

    def __init__(self, run: Run, design: Design | None = None, port: int | None = None) -> None:
        self.run, self.saved = run, {one.name: one for one in run.designs()}
        self.choices = Choices.of(run, design or next(reversed(self.saved.values()), None) or run.fit(name=NAME))
        self._ends_m = np.array([run.config.space.low[:3], run.config.space.high[:3]])  # of places of sensors
        self._before: list[Choices] = []
        self._after: list[Choices] = []
        self._handle, self._scope, self._blind_is_shown = NONE, EVERY, False
        self._reference, self._beside = self.choices.design, None
        self._scenes: dict[tuple[str, tuple[str, ...]], list[Scene]] = {}
        self._scorer, self._training_scores = cache(self._new_scorer), lru_cache(MOST_KEPT)(self._scores_of)
        self._stops, self._ended = threading.Event(), SimpleQueue()
        self._server, self._guard = start_server(port)
        self._page, self._answers = (Worker(f"studio {name}", self._failed) for name in ("page", "answers"))
        design = self.choices.design
        self._stage = Stage(self._server, design.specification, partial(self.wish, "handle"), self._drag)
        names = [*dict.fromkeys([*self.saved, design.name])]
        self._methods = fixed_methods()
        self._panel = ControlPanel(self._server, self.choices, names, self._methods, load_library().names, self.wish)
        self._refresh()

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
        self._ended.put(None)

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def wait(self) -> None:
        """Wait until the page is stopped."""
        self._ended.get()

    def _repr_html_(self) -> str:
        return rendered("studio/templates/frame.html", address=self.address)

    def wish(self, name: str, value: Any = None) -> None:
        """Do what a user asks for on the page: the name of a wish, and its value."""
        key = (name, value[0]) if isinstance(value, tuple) else (name, "")
        # every press of a button counts
        self._page.ask(object() if name == "step" else key, partial(self._do, key, value))

    def _do(self, key: tuple[str, str], value: Any) -> None:
        self._panel.say("")
        changed = getattr(self, f"_on_{key[0]}")(value)
        if changed is None:
            self._show_controls()
        else:
            self._change(changed)

    def _change(self, choices: Choices) -> None:
        """Take over other choices; Undo goes back to those before."""
        if choices.design is not self.choices.design:
            self._reference = self.choices.design
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
            is_free = bool(np.less(*self._ends_m).any())
            self._stage.show_handle(self._pose(), turns=not self._handle.startswith(MOUNT), moves=is_free)
        self._answers.ask("score", partial(self._score, choices, self._beside))
        self._answers.ask("blind", partial(self._find_blind, choices))

    def _scenes_of(self, choices: Choices) -> list[Scene]:
        key = choices.split, choices.settings
        if key not in self._scenes:
            self._scenes[key] = self.run.with_settings(choices.settings).scenes(choices.split, self.run.config.seed)
        return self._scenes[key]

    def _seen(self, design: Design, choices: Choices, detector: str = "ideal") -> SeenScene:
        scene = self._scenes_of(choices)[choices.scene]
        return design.simulate([scene], detector=detector, settings=choices.settings, notes=ignore)[0]

    def _draw(self, design: Design, detector: str = "ideal") -> None:
        """Draw a design in the scene that is chosen, and the one beside it."""
        choices, seen = self.choices, self._seen(design, self.choices, detector)
        self._frames, self._mbps = len(seen.returns), mean_mbps([one.rays for one in seen.returns], Bandwidth())
        one = seen.returns[min(choices.frame, self._frames - 1)]
        self._stage.show_scene(seen.scene, one.frame, [one.rays for one in seen.returns])
        self._stage.show_seen(seen.scene, one)
        self._stage.show_sensors(design.specification.sensors, self._handle)
        self._stage.show_places(choices.mounts_m, choices.boxes(self._ends_m))
        if self._beside is not None:
            beside = self._seen(self._beside, choices, detector)
            self._stage.show_seen(beside.scene, beside.returns[min(choices.frame, len(beside.returns) - 1)], BESIDE)
            self._stage.show_sensors(self._beside.specification.sensors, None, BESIDE)
        self._panel.show_outcomes(one.outcome.tolist())

    def _show_controls(self) -> None:
        # a fit may leave fewer sensors
        self._scope = self._scope if self._scope in self.choices.names else EVERY
        counts = len(self._scenes_of(self.choices)), self._frames
        self._panel.show(self.choices, self._handle, self._scope, counts)
        self._panel.show_pose(self.choices, self._handle, self._pose())

    def _pose(self) -> SensorPose | None:
        """The pose of what has the handle; None without one, and where held-out scenes are looked at."""
        return None if self.choices.split == "test" else self.choices.poses.get(self._handle)

    # What a user asks for: each gives the changed choices, or None.

    def _drag(self, pose: SensorPose, ended: bool) -> None:
        self._page.ask("drag", partial(self._move, pose, ended))

    def _move(self, pose: SensorPose, ended: bool) -> None:
        """Let rays follow the handle; once it is let go, what has changed is fixed."""
        before, choices = self._pose(), self.choices
        if before is None:
            return
        # what moves along a condition has no place of its own
        is_carried = bool(self.run.config.space.conditioned)
        place = before.place_m if is_carried else np.clip(pose.place_m, *self._ends_m)
        if ended and np.abs(np.subtract(place, pose.place_m)).max() > SAME_PLACE_M:
            self._panel.say(f"kept inside the places of this run: {place_text(*self._ends_m)}", is_wrong=True)
        pose = SensorPose.of(place, pose.angles_deg)
        moved = choices if pose == before else choices.moved(self._handle, pose)
        if ended and moved is not choices:
            self._change(moved)
            return
        with self._server.atomic():
            self._draw(moved.design)
            self._stage.show_places(moved.mounts_m, moved.boxes(self._ends_m))
            self._panel.show_pose(choices, self._handle, pose)

    def _on_pose(self, value: Any) -> None:
        which, text = value
        pose = self._pose()
        if pose is not None:
            self._move(SensorPose.of(**{**vars(pose), which: _three_numbers(str(text))}), True)

    def _on_free(self, _: Any) -> Choices:
        return self.choices.freed(self._handle)

    def _on_handle(self, value: Any) -> None:
        self._handle = value if value in self.choices.poses else NONE
        self._refresh()

    def _on_design(self, value: Any) -> Choices | None:
        return Choices.of(self.run, self.saved[value], self.choices) if value in self.saved else None

    def _on_beside(self, value: Any) -> None:
        self._stage.remove("/beside")
        self._beside = self.saved.get(value)
        if value in self._methods:
            self._answers.ask("beside", partial(self._find_baseline, value, self.choices))
        self._refresh()

    def _on_look(self, value: Any) -> None:
        """Show another scene or frame, which changes nothing that could be undone."""
        which, asked = value
        if which == "split":
            place = {"split": SPLITS.get(asked, "train"), "scene": 0, "frame": 0}
        else:
            most = len(self._scenes_of(self.choices)) if which == "scene" else self._frames
            place = {which: min(max(int(asked), 0), most - 1)}
        self.choices = replace(self.choices, **place)
        self._refresh()

    def _on_layer(self, value: Any) -> None:
        name, is_shown = value
        self._stage.set_visible(LAYERS[name], bool(is_shown))
        if name == BLIND:
            self._blind_is_shown = bool(is_shown)
            self._answers.ask("blind", partial(self._find_blind, self.choices))
        if name == DENSITY:
            samples = load_samples(self.run.folder, self.run.config.space)
            points = samples.resample(DENSITY_POINTS, random_generator(self.run.config.seed, "studio"))
            self._stage.show_density(observed_point(points))

    def _on_scope(self, value: Any) -> None:
        self._scope = value if value in self.choices.names else EVERY

    def _on_limit(self, value: Any) -> Choices:
        return self.choices.constrained(value[0], str(value[1]), self._scope)

    def _on_count(self, value: Any) -> Choices:
        return self.choices.constrained(self.choices.count_key, str(int(value)))

    def _on_part(self, value: Any) -> Choices:
        return self.choices.made_of(value if value in self._panel.part.options[1:] else None)

    def _on_detector(self, value: Any) -> Choices | None:
        known = value in self._panel.detector.options
        return replace(self.choices, detector=value, state="changed") if known else None

    def _on_light(self, value: Any) -> Choices:
        lit = replace(self.choices, settings=LIGHTS.get(value, ()), state="changed")
        self._scenes_of(lit)  # refused where the task has no light
        return lit

    def _on_name(self, _: Any) -> None:
        """The command line follows."""

    def _on_step(self, value: Any) -> None:
        steps = (
            partial(self._travel, self._before, self._after),
            partial(self._travel, self._after, self._before),
            partial(self._answers.ask, "fit", partial(self._find_fit, self.choices)),
            self._stops.set,
            partial(self._answers.ask, "evaluate", partial(self._evaluate, self.choices)),
        )
        if value in STEPS:
            steps[STEPS.index(value)]()

    def _travel(self, source: list[Choices], goal: list[Choices]) -> None:
        if source:
            goal.append(self.choices)
            self._reference, self.choices = self.choices.design, source.pop()
            self._refresh()

    # Answers, which are found beside the page and shown where they are still asked for.

    def _step(self, label: str | None, *_: Any) -> None:
        """Show what is under way, or end it.

        Raises:
            StoppedError: The user stopped it.
        """
        if self._stops.is_set():
            raise StoppedError
        self._panel.say(f"{label} ..." if label else "")

    def _begin(self, label: str) -> None:
        self._stops.clear()
        self._step(label)

    def _find_fit(self, choices: Choices) -> None:
        self._begin("fitting")
        remarks: list[str] = []
        design = choices.fit(NAME, progress=self._step, notes=remarks.append)
        remarks = [remark for remark in remarks if not isinstance(remark, BackgroundNote)]
        self._page.ask("fitted", partial(self._take_fit, choices, design, remarks))

    def _take_fit(self, asked: Choices, design: Design, remarks: list[str]) -> None:
        is_new = self.choices.key == asked.key
        self._panel.say("\n".join(remarks) if is_new else "the choices have changed: press Fit again")
        if is_new:
            self._change(replace(self.choices, design=design, state="fitted"))

    def _find_baseline(self, name: str, choices: Choices) -> None:
        self._begin(f"choosing the rays of {name}")
        found = self.run.fit(method=name, rays=choices.design.usual_count(ignore), name=name)
        self._page.ask("found", partial(self._take_beside, found))

    def _take_beside(self, design: Design) -> None:
        self._beside = design
        self._panel.say("")
        self._refresh()

    def _find_blind(self, choices: Choices) -> None:
        if self._blind_is_shown:
            surface = self._seen(choices.design, choices).unseen()
            self._page.ask("blind", partial(self._stage.show_blind, *surface))

    def _score(self, choices: Choices, beside: Design | None) -> None:
        metric, world = self.run.metric, (choices.detector, choices.settings)
        values = self._training_scores(choices.design, *world)
        how = {"groups": group_numbers(self._scorer(*world).scenes(SCENES)), "limits": metric.limits}
        lines = [
            f"{_figure(mean_interval(values, **how), metric.unit)} {metric.name}, {metric.better} is better, "
            f"on {len(values)} training scenes kept for comparing"
        ]
        for name, other in (("before the last change", self._reference), (beside and beside.name, beside)):
            if other is not None and other is not choices.design:
                difference = paired_difference(values, self._training_scores(other, *world), **how)
                lines.append(comparison(difference, str(name), metric.better, metric.unit))
        self._page.ask("scored", partial(self._show_status, choices, lines))

    def _new_scorer(self, detector: str, settings: tuple[str, ...]) -> TrainingScorer:
        """A scorer of training scenes that no fit chooses on, the same for all designs; others are left for scores."""
        run = self.run.with_settings(settings)
        training, planner = TrainingScenes(run, run.config.seed), Measuring(detector).planner(run.metric)
        return TrainingScorer(
            run.task,
            self.run.metric,
            training.seed,
            training.scenes(PURPOSE),
            planner,
            preparation=Preparation.of_run(training, planner),
        )

    def _scores_of(self, design: Design, detector: str, settings: tuple[str, ...]) -> np.ndarray:
        """The score of a design in each of these scenes."""
        run, scorer = self.run.with_settings(settings), self._scorer(detector, settings)
        rays = fired(design.specification, design.usual_count(ignore), run.conditions(), scorer.planner, run.task)
        return scorer.scores([rays], SCENES)[:, 0]

    def _show_status(self, choices: Choices, lines: list[str]) -> None:
        if choices.design is self.choices.design:
            tight = sorted(choices.tight())
            further = [f"limited by {', '.join(tight)}"] if tight else []
            self._panel.say_status([f"{choices.headline}, {self._mbps:.3g} Mbit/s", *lines, *further])

    def _evaluate(self, choices: Choices) -> None:
        self._begin("scoring on held-out scenes")
        beside = self._beside
        is_saved = beside is not None and self.saved.get(beside.name) is beside and beside.name != choices.design.name
        scores = self.run.evaluate(
            [choices.design, *([beside] if is_saved else [])],
            rays=[choices.design.usual_count(ignore)],
            detector=choices.detector,
            settings=choices.settings,
            progress=lambda name, done, total: self._step(f"{name}: {done} of {total} held-out scenes"),
            notes=ignore,
        )
        self._page.ask("evaluated", partial(self._show_scores, scores))

    def _show_scores(self, scores: Scores) -> None:
        metric = self.run.metric
        rows = [(row, _figure(Interval(row.value, row.ci_low, row.ci_high), "")) for row in scores.rows]
        text = rendered("studio/templates/scores.md", scenes=scores.evaluation.scenes, metric=metric, rows=rows)
        self._panel.show_scores(text, scores.figure("bandwidth"))
        row = scores.rows[0]
        value = _figure(Interval(row.value, row.ci_low, row.ci_high), metric.unit)
        self._panel.say(f"{row.design}: {value} on held-out scenes; the tab Scores has the baselines")

    # What is kept.

    def _on_save(self, _: Any) -> None:
        name, choices, folder = str(self._panel.name.value).strip(), self.choices, self.run.folder
        check_name(name)
        if choices.state != "fitted":
            raise ConfigError(
                "there is no fit of these choices yet",
                where="Save",
                hint="press Fit first: what you moved or turned stays",
            )
        if self.run.design_path(name).exists():
            raise ConfigError(f"there is a design {name!r}", where="name", allowed="another name")
        design = Design(replace(choices.design.specification, name=name), self.run, None, choices.design.result)
        design.save()
        with locked_run(folder, self.run.created):
            write_recorded(folder, f"{CONSTRAINTS}/{name}.yaml", dump_yaml(dict(choices.constraints)).encode())
        self.saved[name] = design
        self._panel.add_design(name)
        self._panel.say_saved(f"saved {design.path} and {folder / CONSTRAINTS / name}.yaml")
        self._change(replace(choices, design=design, base=design, state="saved"))
        self._reference = design

    def _on_mounts(self, _: Any) -> None:
        page = self._exported("mounts") / "mounts.html"
        self._server.send_file_download(f"{page.parent.name}.html", page.read_bytes())

    def _on_export(self, value: Any) -> None:
        if value in FORMATS.names():
            self._exported(value)

    def _exported(self, name: str) -> Path:
        design = self.choices.design
        if design.path is None:
            raise ConfigError("only saved designs are exported", where="Export", hint="press Save first")
        path = design.export(format=name, notes=ignore).path
        self._panel.say_saved(f"wrote {path}")
        return path

    def _failed(self, error: Exception) -> None:
        """Show what went wrong; the page goes on."""
        if isinstance(error, StoppedError):
            self._panel.say("stopped")
            return
        is_known = isinstance(error, LidardesignError)
        title, body = ("This cannot be done", f"{error}") if is_known else ("This is a bug", f"{error!r}")
        # a tab that is opened later shows it, too
        self._panel.say(f"{title}: {body}", is_wrong=True)
        for client in self._server.get_clients().values():
            client.add_notification(title, body, color="red")
        with suppress(Exception):  # what failed may be this
            self._show_controls()


def _figure(interval: Interval, unit: str) -> str:
    value, low, high = figure_and_interval(interval.mean, interval.low, interval.high)
    ends = "" if interval.low is None else f" ({low} to {high})"
    return f"{value} {unit}".rstrip() + ends


def _three_numbers(text: str) -> list[float]:
    """The numbers of a text like `0.1, 0, -2`.

    Raises:
        ConfigError: Others than three finite numbers.
    """
    with suppress(ValueError):
        numbers = [float(word) for word in text.replace(",", " ").split()]
        if len(numbers) == 3 and np.isfinite(numbers).all():
            return numbers
    raise ConfigError(f"{text!r} is no pose", where="Move", allowed="three numbers, as 0.1, 0, -2")
