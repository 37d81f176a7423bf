"""The problem of a user: a fit of the density, or a design by a method of the entry-point group."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

from lidardesign.choices.fit import LAYOUTS
from lidardesign.choices.flag import flags_of
from lidardesign.errors import ConfigError, check_choice
from lidardesign.fitting.options import DesignChoices, fit_choices
from lidardesign.fitting.request import FitRequest
from lidardesign.formats.designs import relative_folder
from lidardesign.plugins import plugin_guard
from lidardesign.problem.method import DESIGN, METHODS, Method, design_by, refusal_of
from lidardesign.problem.problem import DesignResult, Problem
from lidardesign.problem.world import World
from lidardesign.rays.training_scenes import TrainingScenes
from lidardesign.run.manifest import versions
from lidardesign.run_folder import Notes, RunFolder, log_note
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.plan import Planner
from lidardesign.task import mount_of

# What a method is told; it keeps to no constraints.
KEPT = ("method", "rays", "gates", "name", "seed", "workers")


@dataclass(frozen=True, eq=False)
class MethodRequest:
    """A design by a method, with nothing left open.

    Arguments:
        run: The run.
        name: The design's name.
        method: The method.
        problem: Its problem.
        notes: Called with every note.
    """

    run: RunFolder
    name: str
    method: Method
    problem: Problem
    notes: Notes

    command = "fit"

    @classmethod
    def resolve(cls, run: RunFolder, given: DesignChoices, notes: Notes = log_note) -> MethodRequest:
        """The request of a user's choices, which name a method.

        Raises:
            ConfigError: The method is unknown, needs a design, or keeps not to a choice.
        """
        choices = fit_choices({**given, "method": None})
        check_choice(str(given["method"]), "--method", [*LAYOUTS, *METHODS.names()])
        method = METHODS.load(str(given["method"]))
        where = f"--method {method.name}"
        for key, flag in flags_of(DesignChoices).items():
            value = choices[key]  # type: ignore[literal-required]
            if key not in KEPT and value and value != flag.default:
                hint = f"leave it out: lidardesign fit RUN --method {method.name}"
                raise ConfigError(
                    f"makes a design of its own, and keeps to no such choice as {flag.option}", where=where, hint=hint
                )
        if DESIGN in method.needs or method.is_redrawn:
            fault = "draws other rays in every scene" if method.is_redrawn else "begins with a design"
            raise ConfigError(f"it {fault}", where=where, hint=f"lidardesign evaluate RUN --baseline {method.name}")
        numbers = sorted(run.task.defaults.rays)
        seed = run.config.seed if choices["seed"] is None else choices["seed"]
        learned, training = run.scenes("train", seed), TrainingScenes(run, seed)
        problem = Problem(
            World(run.task, run.config.task, run.config.space, seed, learned, training, Planner()),
            rays=numbers[len(numbers) // 2] if choices["rays"] is None else choices["rays"],
            gates=choices["gates"] or "sensor",
        )
        if len(problem.world.conditions) > 1:
            raise ConfigError(
                f"has no fixed list of rays along {', '.join(problem.world.conditions[0])}",
                where=where,
                allowed=", ".join(LAYOUTS[:2]),
            )
        refusal = refusal_of(method, problem)
        if refusal is not None:
            raise ConfigError(f"makes no design: {refusal or 'there are no scenes'}", where=where)
        return cls(run, choices["name"] or "fit", method, problem, notes)

    def design(self) -> DesignSpec:
        """The design that the method makes."""
        # there is none only where no number of rays is asked for
        result = cast(DesignResult, design_by(self.method, self.problem))
        for note in result.notes:
            self.notes(note)
        if self.problem.gates == "ray" and not result.design.has_gates_per_ray:
            self.notes(f"the method {self.method.name} gives all rays of a sensor one gate, whatever --gates says")
        run, world = self.run, self.problem.world
        with plugin_guard(run.task.name):
            mount = mount_of(run.task, run.config.task)
        provenance: Mapping[str, Any] = {
            **result.design.provenance,
            "command": self.command,
            "method": self.method.name,
            "task": run.task.name,
            "run": relative_folder(run.folder, run.design_path(self.name)),
            "seed": world.seed,
            "versions": versions(),
        }
        return replace(result.design, name=self.name, mount=mount, provenance=provenance)


def problem_of(
    run: RunFolder, given: DesignChoices, base: DesignSpec | None = None, *, notes: Notes = log_note
) -> FitRequest | MethodRequest:
    """The request of a user's choices: a fit of the density, unless they name another method.

    Raises:
        ConfigError: Choices that do not fit together.
    """
    method, layout = given.get("method"), given.get("layout")
    if method is not None and layout is not None:
        raise ConfigError("is given beside --layout", where="--method", allowed="one of the two")
    if method is None or method in LAYOUTS:
        return FitRequest.resolve(run, {**given, "layout": layout or method, "method": None}, base, notes=notes)
    return MethodRequest.resolve(run, given, notes)
