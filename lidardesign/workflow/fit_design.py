"""How a design is fitted, its rays chosen on scenes where that is asked for, and checked before anyone sees it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from lidardesign.design.constraints.check import ConstraintCheck, check_design
from lidardesign.design.files import design_document
from lidardesign.design.fit import FitResult
from lidardesign.design.fit import fit as fit_samples
from lidardesign.design.layouts.quantise import SAMPLES_PER_RAY
from lidardesign.design.layouts.rays import LAYOUTS
from lidardesign.design.layouts.track import travelled
from lidardesign.design.mixture.support import LEAST_SAMPLES, MOVED_SAMPLES, at_condition, condition_text
from lidardesign.design.sensor import DesignSpec
from lidardesign.errors import DataError, InfeasibleError
from lidardesign.run.clock import phase
from lidardesign.run.manifest import versions
from lidardesign.run.yaml import dump_yaml, parse_yaml
from lidardesign.samples import Samples, load_samples
from lidardesign.task import conditions_of, random_generator
from lidardesign.workflow.fit import FitRequest
from lidardesign.workflow.run_folder import Notes, log_note, relative_folder
from lidardesign.workflow.run_samples import KEY, RunTarget


class Fitter:
    """Fits the design of a request, to samples weighted by its settings of the task.

    Raises:
        ConfigError: A setting that cannot be, or a name that is no condition of the density.
        DataError: The density is too rough, with or without the settings.
    """

    def __init__(self, request: FitRequest, notes: Notes = log_note) -> None:
        self.request, self.notes = request, notes
        self.target = RunTarget(request.run, weighting=request.weighting)
        request.run.config.space.at(request.at)
        with phase("samples"):
            self.samples = load_samples(request.run.folder)
            self._check_effective_samples("learn longer (--preset standard or fine), or with a larger density.sigma_m")
            if request.weighting.settings:
                before = self.samples.effective_sample_size
                self.samples = self.samples.retargeted(self.target(self.samples.points))
                self._check_effective_samples("a setting nearer to what was learned, or learn with it")
                now, settings = self.samples.effective_sample_size, ", ".join(request.weighting.settings)
                notes(f"with {settings} the samples have ESS {now:.2f}, as learned {before:.2f}")

    def _check_effective_samples(self, hint: str) -> None:
        """Refuse samples of which too few are effective to fit anything to, whatever the constraints."""
        effective = self.samples.effective_sample_size * len(self.samples)
        if effective < LEAST_SAMPLES:
            raise DataError(
                f"the density is too rough: its {len(self.samples)} samples are worth {effective:.0f}",
                where=str(self.request.run.folder),
                allowed=f"at least {LEAST_SAMPLES}",
                hint=hint,
            )

    @phase("fitting")
    def fit(self, samples: Samples | None = None, **choices: Any) -> FitResult:
        """The design, by the request's choices and these instead of some of them, to other samples if there are."""
        request, samples = self.request, self.samples if samples is None else samples
        if request.at:
            count = max(MOVED_SAMPLES, SAMPLES_PER_RAY * (request.choices.get("rays") or 0))
            samples = at_condition(samples, request.at, self.target, count, random_generator(request.seed, "condition"))
            place, ess = condition_text(request.at), samples.effective_sample_size
            self.notes(f"at {place} {len(samples)} samples have ESS {ess:.2f}")
        return fit_samples(
            samples,
            constraints=request.constraints,
            seed=request.seed,
            name=request.name,
            retarget=self.target,
            **{**request.choices, **choices},
        )


def fit_design(request: FitRequest, *, notes: Notes = log_note) -> FitResult:
    """Fit the design of a request and check it; nothing is written.

    Arguments:
        request: What is asked for.
        notes: Called with every note.

    Returns:
        The fit, whose design says where it came from and whose checks are of the design's own text.

    Raises:
        ConfigError: Choices that do not fit together.
        DataError: The density is too rough.
        InfeasibleError: Constraints that contradict each other, or that the design does not keep.
    """
    run, weighting, fitter = request.run, request.weighting, Fitter(request, notes)
    result = _selected(fitter) if LAYOUTS[request.choices["layout"]].chosen_on_scenes else fitter.fit()
    for note in result.notes:
        notes(note)
    design, further = result.design, {KEY: weighting.as_document()} if weighting.settings else {}
    if len(request.names) == len(design.sensors):
        named = (replace(sensor, name=name) for sensor, name in zip(design.sensors, request.names, strict=True))
        design = replace(design, sensors=tuple(named))
    origin = {
        "command": request.command,
        "task": run.task.name,
        "run": relative_folder(run.folder, run.design_path(request.name)),
        "seed": request.seed,
        "versions": versions(),
    }
    design = replace(design, provenance={**design.provenance, **origin, **further})
    with phase("writing"):
        checks = check_written(design, request)
    # broken ones were refused
    return replace(result, design=design, constraints=checks, satisfied=True)


def _selected(fitter: Fitter) -> FitResult:
    """Sensors with rays that were chosen on scenes: of the number that was asked for, or of each of the task's."""
    from lidardesign.workflow.select_rays import near, select_rays

    request, samples = fitter.request, fitter.samples
    counts = sorted({request.choices["rays"]} if request.choices["rays"] else set(request.run.task.defaults.rays))
    if samples.space.conditioned:
        travelled(samples.space, "selected")
    # the rays of a track have gates of their own, as those of a scan
    gates = request.choices["gates"] or ("ray" if samples.space.conditioned else LAYOUTS["selected"].usual_gates)
    # sensors' own gates keep a bandwidth themselves, those of rays are priced when they are chosen
    layout = "density" if gates == "ray" else "grid"
    (first, *_) = conditions_of(request.run.task, request.run.config.task, samples.space)
    # a sensor that moves along a condition looks everywhere the same way
    fitted = fitter.fit(near(samples, first, 1.0), layout=layout, rays=counts[-1], gates=gates)
    fitted = replace(fitted, design=replace(fitted.design, gates=gates))
    return select_rays(request.run, fitted, counts, samples, request.seed)


def check_written(design: DesignSpec, request: FitRequest) -> list[ConstraintCheck]:
    """Check a design's own text against its constraints with code that the fit does not share.

    Raises:
        InfeasibleError: A constraint does not hold.
    """
    if request.constraints is None:
        return []
    written = parse_yaml(dump_yaml(design_document(design)), where=design.name).value
    checks = list(check_design(written, request.constraints, request.run.config.space))
    broken = [check for check in checks if not check.satisfied]
    if broken:
        first = broken[0]
        raise InfeasibleError(
            f"the best design found breaks {first.name}: {first.value}, bound {first.bound}",
            conflicts=[check.name for check in broken],
            hint="loosen one of the constraints; no file was written",
        )
    return checks
