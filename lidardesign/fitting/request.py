"""What a fit is asked for: the choices of a user, resolved by the run, an earlier design, constraints and a rig."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from lidardesign.config import with_task_settings
from lidardesign.constraints.document import MOST_FITTED, Constraints
from lidardesign.constraints.origins import is_mounted, snap_to_space
from lidardesign.constraints.rig_constraints import moved_notes, rig_constraints, rig_notes
from lidardesign.errors import MAX_SEED, ConfigError, check_choice, check_number
from lidardesign.fitting.run_samples import Weighting
from lidardesign.layouts.layout import Layout
from lidardesign.layouts.rays import LAYOUTS, gates_of, layout_of
from lidardesign.rays.information import informs_rays
from lidardesign.run.overrides import apply_override, parse_override
from lidardesign.run.yaml import Document, KeyPath, leaves, load_yaml
from lidardesign.run_folder import (
    Notes,
    RunFolder,
    log_note,
    reach_of,
    read_design,
    settings_texts,
)
from lidardesign.sensors.sensor import FITTED_LAYOUTS, LEVELS, MOST_RAYS, DesignSpec, Gates
from lidardesign.task import Task

BEST = "best"  # as many sensors as score best on training scenes
COUNTS = (1, 2, 3, 4, 6, 8)  # of sensors, that are tried for that
CHOSEN_LEVEL = 0.999  # rays are chosen inside fields and gates: narrower ones would only leave candidates out
# Of designs: names that a file may have everywhere.
NAME_PATTERN = re.compile(r"[^\W.][\w.+-]{0,99}")
# Keys by which tasks are told where sensors may be.
PLACE_KEYS = ("origin_m", "origin_box_m")


@dataclass(frozen=True, kw_only=True)
class FitOptions:
    """What a user may choose for a fit; what is left out follows from an earlier design, the constraints or the task.

    Arguments:
        sensors: How many sensors, or "best": as many as score best on training scenes. A scan has one per ray.
        constraints: Constraints, a mapping of them, or a YAML file of them.
        layout: grid, density, scan, distributed, selected or spinning.
        rays: Rays per frame over all sensors.
        channels: Rings of each sensor that spins.
        gates: "sensor" or "ray": one gate per sensor, or one per ray.
        level: The share of rays and returns that fields of view and gates hold.
        at: Values of conditions that the design is for, such as {"x_m": 0.37}.
        weights: Settings of the task towards which the learned density is weighted.
        parts: Real parts that the design is made of: names, `NAME:MODE`, paths of part files, or "catalog".
        like: The file of a rig to be like: as many sensors at its places, none wider, as many rays.
        name: The design's name.
        seed: Seed of all random numbers; the run's by default.

    Raises:
        ConfigError: A name, a layout or gates that cannot be.
    """

    sensors: int | str | None = None
    constraints: Constraints | Mapping[str, Any] | Path | str | None = None
    layout: str | None = None
    rays: int | None = None
    channels: int | None = None
    gates: str | None = None
    level: float | None = None
    at: Mapping[str, float] = field(default_factory=dict)
    weights: Sequence[str] | Mapping[str, Any] = ()
    parts: Sequence[str] | str | None = None
    like: Path | str | None = None
    name: str | None = None
    seed: int | None = None

    def __post_init__(self) -> None:
        if self.name is not None and not NAME_PATTERN.fullmatch(self.name):
            allowed = "letters, digits, _, -, + and . (not in front), at most 100"
            raise ConfigError(f"{self.name!r} is not a name for a design", where="--name", allowed=allowed)
        if self.layout is not None:
            check_choice(self.layout, "--layout", FITTED_LAYOUTS)
        if self.gates is not None:
            check_choice(self.gates, "--gates", get_args(Gates))
        if self.sensors not in (None, BEST, *range(1, MOST_FITTED + 1)):
            allowed = f"a whole number from 1 to {MOST_FITTED}, or best"
            raise ConfigError(repr(self.sensors), where="--sensors", allowed=allowed)
        limits = {"rays": (1, MOST_RAYS), "channels": (1, MOST_FITTED), "seed": (0, MAX_SEED)}
        for name, (low, high) in limits.items():
            if getattr(self, name) is not None:
                check_number(getattr(self, name), f"--{name}", low, high, whole=True)
        if self.level is not None:
            check_number(self.level, "--level", *LEVELS)


@dataclass(frozen=True, eq=False)
class FitRequest:
    """A fit with nothing left open.

    Arguments:
        run: The run whose samples are fitted to.
        name: The design's name.
        seed: Root of the random streams.
        constraints: Checked constraints, or None.
        at: Condition values that the design is for; without any, one for all of them.
        choices: sensors, layout, rays, gates and level, as `lidardesign.mixture.fit.fit` takes them.
        weighting: Settings of the task to whose scenes the density is weighted.
        channels: Rings of each sensor that spins.
        names: What sensors are called, where there are as many; none numbers them.
        command: For the design's provenance.
    """

    run: RunFolder
    name: str
    seed: int
    constraints: Constraints | None = None
    at: Mapping[str, float] = field(default_factory=dict)
    choices: Mapping[str, Any] = field(default_factory=dict)
    weighting: Weighting = field(default_factory=Weighting)
    channels: int | None = None
    names: Sequence[str] = ()
    command: str = "fit"

    @classmethod
    def resolve(
        cls,
        run: RunFolder,
        options: FitOptions,
        base: DesignSpec | None = None,
        *,
        notes: Notes = log_note,
    ) -> FitRequest:
        """The request of a user's choices.

        Arguments:
            run: The run.
            options: The choices.
            base: An earlier design, which says what the user does not.
            notes: Called with every note.

        Raises:
            ConfigError: Choices that do not fit together.
            DataError: The rig cannot be read.
            InfeasibleError: The rig stands where the run's sensors may not.
        """
        for note in run.input_notes():
            notes(note)
        defaults, asked = run.task.defaults, load_constraints(options.constraints, notes=notes)
        if asked is None and base is not None:
            asked = Constraints()
        constraints, layout, names = _with_rig(options, _with_parts(options, asked, run), run, notes)
        if constraints is not None:
            constraints, moved = snap_to_space(constraints, run.config.space)
            for note in moved:
                notes(note)
        rules = constraints or Constraints()
        layout = layout or _usual_layout(rules, base, run, options)
        beside = {
            "--at": options.at or (base is not None and base.at),
            "--weight": options.weights,
            "parts": rules.parts,
        }
        if LAYOUTS[layout].chosen_on_scenes and any(beside.values()):
            raise ConfigError(
                f"layout {layout} with {next(name for name, given in beside.items() if given)}",
                where="--layout",
                allowed=", ".join(name for name in FITTED_LAYOUTS if not LAYOUTS[name].chosen_on_scenes),
                hint="rays are chosen by what scenes show alone",
            )
        if options.sensors is not None and LAYOUTS[layout].one_sensor_per_ray:
            raise ConfigError(
                f"{options.sensors} sensors for a scan, in which every ray is its own sensor",
                where="--sensors",
                hint="give --rays N alone, or another --layout",
            )
        channels = options.channels
        if layout == "spinning" and channels is None and base is not None:
            channels = base.provenance.get("channels")
        elif layout != "spinning" and channels is not None:
            raise ConfigError(f"{channels} channels in the layout {layout}", where="--channels", allowed="spinning")
        if layout == "spinning" and options.gates == "ray":
            raise ConfigError("a gate per ray in the layout spinning", where="--gates", allowed="sensor")
        usual_level = CHOSEN_LEVEL if LAYOUTS[layout].chosen_on_scenes else defaults.level
        level = options.level if options.level is not None else base.level if base else usual_level
        weighting = _weighting(settings_texts(options.weights), base)
        if weighting.settings:
            with_task_settings(run.task, run.config, weighting.settings, option=weighting.origin)
        most_rays = None if LAYOUTS[layout].leaves_rays_open(options.gates) else max(defaults.rays)
        return cls(
            run,
            options.name or ("fit" if asked is None else "constrained"),
            run.config.seed if options.seed is None else options.seed,
            constraints,
            {**(base.at if base else {}), **options.at},
            {
                "sensors": _sensors(options.sensors, rules, base, LAYOUTS[layout]),
                "layout": layout,
                "rays": _rays(options.rays, rules, base, most_rays),
                "gates": options.gates or _own_gates(base, layout),
                "level": level,
            },
            weighting,
            channels,
            names,
            "fit" if asked is None else "constrain",
        )


def check_chosen(task: Task, layout: str) -> None:
    """Refuse layouts whose rays are chosen where a task has no method informs.

    Raises:
        ConfigError: It does not.
    """
    if not informs_rays(task):
        raise ConfigError(
            f"the task {task.name} has no method informs",
            where=f"--layout {layout}",
            allowed="tasks with informs",
            hint="another --layout, or give the task a method informs(scene, returns)",
        )


def _with_rig(
    options: FitOptions, asked: Constraints | None, run: RunFolder, notes: Notes
) -> tuple[Constraints | None, str | None, tuple[str, ...]]:
    """Constraints with those of a rig below them, the layout, and the rig's sensors' names; as asked without a rig."""
    if options.like is None:
        return asked, options.layout, ()
    layout = options.layout or "grid"
    if not LAYOUTS[layout].starts_at_sensors:
        allowed = [name for name in FITTED_LAYOUTS if LAYOUTS[name].starts_at_sensors]
        raise ConfigError(f"{layout} together with --like", where="--layout", allowed=", ".join(allowed))
    rig = read_design(Path(options.like), notes, reach_of([run]))
    own, space = Constraints() if asked is None else asked, run.config.space
    keys = " / ".join(key for key in PLACE_KEYS if key in type(run.config.task).model_fields)
    keys = keys or "the keys x_m, y_m and z_m of its space"
    hint = f"learn with {keys} for the rig's places: lidardesign tasks show {run.task.name}"
    constraints = rig_constraints(rig, space, own, rays=options.rays, hint=hint)
    for line in (*rig_notes(rig, constraints, own), *moved_notes(rig, space, constraints)):
        notes(line)
    return constraints, layout, tuple(sensor.name for sensor in rig.sensors)


def _with_parts(options: FitOptions, asked: Constraints | None, run: RunFolder) -> Constraints | None:
    """The constraints with the parts that a user named, and how many where they say so."""
    if options.parts is not None:
        document = {} if asked is None else asked.as_document()
        asked = Constraints.from_mapping({**document, "parts": {**document.get("parts", {}), "names": options.parts}})
    if asked is None or asked.parts is None:
        return asked
    from lidardesign.parts.catalogue import named_parts

    named_parts(asked.parts.names, asked.parts.each)
    lacking = {
        "the number of parts is missing": not isinstance(options.sensors, int) and asked.parts.count is None,
        "parts together with --at or --weight": options.at or options.weights,
        "parts together with each, which bounds single sensors": asked.each,
        f"parts in the layout {options.layout}": options.layout,
        "parts with --gates: parts have the gates that they have": options.gates,
        f"the task {run.task.name} has no method informs": not informs_rays(run.task),
    }
    for fault, is_found in lacking.items():
        if is_found:
            raise ConfigError(
                fault, where="--parts", allowed="--parts NAME,NAME --sensors N, or parts.names, parts.count"
            )
    return asked


def _usual_layout(constraints: Constraints, base: DesignSpec | None, run: RunFolder, options: FitOptions) -> str:
    """The layout where none is named: the design's; else rays are chosen where scenes can say what they tell."""
    if constraints.parts is not None:
        return "grid"
    if base is not None:
        layout = layout_of(base)
        return layout.name if layout.chosen_on_scenes else layout.fitted_as
    if informs_rays(run.task) and not options.at and not options.weights:
        return "selected"
    # a scan has as many sensors as rays
    return "scan" if run.config.space.conditioned and options.sensors is None else "grid"


def _own_gates(base: DesignSpec | None, layout: str) -> Gates | None:
    """The gates of a design that is fitted again in its layout, where they are not the usual ones."""
    if base is None or layout_of(base).name != layout:
        return None
    gates = gates_of(base)
    return None if gates == LAYOUTS[layout].usual_gates else gates


def _sensors(
    asked: int | str | None, constraints: Constraints, base: DesignSpec | None, layout: Layout
) -> int | str | None:
    """The number of sensors: the user's, then what the constraints ask for, the design's, the best."""
    bounds = constraints.sensors
    if asked is None and constraints.parts is not None:
        return constraints.parts.count
    if layout.name == "spinning" and isinstance(asked, str):
        raise ConfigError(f"{asked!r} sensors that spin", where="--sensors", allowed="a whole number")
    if asked is not None or bounds.count is not None or is_mounted(constraints.rules):  # mounts say how many
        return asked if asked is not None else bounds.count
    if base is None:
        return None if layout.one_sensor_per_ray else 1 if layout.name == "spinning" else BEST
    usual = max(len(base.sensors), len(constraints.each), bounds.min or 1)
    return min(usual, bounds.max or usual)


def _rays(asked: int | None, constraints: Constraints, base: DesignSpec | None, usual: int | None) -> int | None:
    """The number of rays: the user's, then the constraints', the design's, the usual; parts bring their own."""
    if asked is not None or constraints.parts is not None:
        return asked
    if constraints.budget.rays is not None:
        return constraints.budget.rays
    return base.rays if base is not None and base.rays is not None else usual


def _weighting(settings: tuple[str, ...], base: DesignSpec | None) -> Weighting:
    """How samples are weighted: by the user's settings, else as they were for the design."""
    return Weighting(settings) if settings or base is None else Weighting.of(base)


def load_constraints(
    given: Constraints | Mapping[str, Any] | Path | str | None, overrides: Sequence[str] = (), notes: Notes = log_note
) -> Constraints | None:
    """Constraints of a mapping or a YAML file, with `--set` laid over them; None where nothing is given.

    Raises:
        ConfigError: At file:line:column, or at the `--set` option; also for parts that there are none of.
    """
    if isinstance(given, Constraints) or (given is None and not overrides):
        return given
    if isinstance(given, Mapping):
        return Constraints.from_mapping(given)
    document = load_yaml(Path(given)) if given else Document({}, "constraints")
    values: dict[str, Any] = document.mapping
    if given and all(value in (None, {}, []) for _, value in leaves(values)):
        notes(f"{document.where} holds no constraints")
    origins: dict[KeyPath, str] = {}
    for text in overrides:
        override = parse_override(text)
        origins[apply_override(values, override)] = override.where

    def locate(path: KeyPath, *, key: bool = False) -> str:
        path = tuple(path)
        for origin, where in origins.items():
            if path[: len(origin)] == origin or origin[: len(path)] == path != ():
                return where
        return document.locate(path, key=key)

    return Constraints.from_mapping(values, where=document.where, locate=locate)
