"""From a design to the explicit list of rays that it fires, by its layout.

Rays start at their sensor's mean origin, in the layout `distributed` across its origins; they are ordered by sensor (an
explicit table keeps its own order), and fire evenly over the frame: ray i of n at i / (n * rate).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lidardesign.constraints.document import Constraints
from lidardesign.errors import ConfigError
from lidardesign.layouts.density import DensityLayout
from lidardesign.layouts.distributed import DistributedLayout
from lidardesign.layouts.gates import GridLayout
from lidardesign.layouts.layout import Layout
from lidardesign.layouts.scan import ScanLayout
from lidardesign.layouts.track import moved, placed
from lidardesign.mixture.support import Retarget, conditioned
from lidardesign.samples import Samples
from lidardesign.scenes.rays import DEFAULT_RATE_HZ, Rays, fire_times
from lidardesign.sensors.bandwidth import split_budget
from lidardesign.sensors.sensor import CERTIFICATES, DesignSpec, Gates


class SelectedLayout(Layout):
    """Rays that were chosen on training scenes, a table for each number of rays; see `lidardesign.rays`."""

    name = "selected"
    fitted_as = "density"
    chosen_on_scenes = True

    def leaves_rays_open(self, gates: Gates | None) -> bool:
        """See `Layout`: a table is chosen for each of several numbers."""
        return True

    def check_constraints(self, constraints: Constraints) -> None:
        """See `Layout`."""
        raise ConfigError(
            "rays are chosen on scenes, and samples alone have none", where=f"--layout {self.name}",
            hint=f"lidardesign fit RUN --layout {self.name}; in Python, Run.fit",
        )  # fmt: skip

    def needs_samples(self, spec: DesignSpec, count: int | None, gates: Gates) -> bool:
        """See `Layout`."""
        return False

    def counts(self, spec: DesignSpec) -> list[int]:
        """See `Layout`."""
        tables = [len(table) for table in (spec.ray_table, *spec.further_tables) if table is not None]
        tracks = [len(track.sensor) for track in (spec.track, *spec.further_tracks) if track is not None]
        return sorted(tables + tracks)

    def lay_out(self, spec: DesignSpec, count: int, samples: Samples | None, gates: Gates, seed: int) -> Rays:
        """See `Layout`."""
        for table in spec.further_tables:
            if len(table) == count:
                return table
        raise ConfigError(
            f"{count} rays, which were not chosen",
            where=spec.name,
            allowed=", ".join(map(str, self.counts(spec))),
            hint=f"lidardesign fit RUN --layout selected --rays {count}",
        )


CERTIFIED = ("rays", "value", "bound", "gap", "held_back_value", "candidates", "gates", "scenes")


def certificates_of(design: DesignSpec) -> list[Mapping[str, float]]:
    """How far from the best a design's chosen rays may be, one entry per number of rays; none that is damaged."""
    found = design.provenance.get(CERTIFICATES)
    return [
        entry
        for entry in (found if isinstance(found, list) else ())
        if isinstance(entry, dict) and all(type(entry.get(name)) in (int, float) for name in CERTIFIED)
    ]


class FixedLayout(Layout):
    """The rays of a table, as real parts fire them; of fewer rays an evenly spread subset."""

    name = "fixed"
    # fixed rays are what they are: sensors like those of parts have even rays
    fitted_as = "grid"
    follows_from_samples = False

    def check_constraints(self, constraints: Constraints) -> None:
        """See `Layout`."""
        raise ConfigError("the rays of real parts cannot be fitted", where="--layout fixed", hint="--layout grid")

    def most_count(self, spec: DesignSpec) -> int | None:
        """See `Layout`."""
        return None if spec.ray_table is None else len(spec.ray_table)

    def lay_out(self, spec: DesignSpec, count: int, samples: Samples | None, gates: Gates, seed: int) -> Rays:
        """See `Layout`: each sensor's rays in proportion."""
        table = spec.ray_table
        if table is None or count > len(table):
            raise ConfigError(
                f"{count} rays, but the design's fixed pattern has {0 if table is None else len(table)}",
                where=spec.name,
                allowed=None if table is None else f"at most {len(table)}",
                hint="a design of more parts: lidardesign catalog show NAME --rays N --out FILE",
            )
        own = np.bincount(table.sensor, minlength=len(spec.sensors))
        shares = split_budget(own, count)
        of_sensor = [np.flatnonzero(table.sensor == index) for index in range(len(own))]
        from lidardesign.parts.part import even_subset

        chosen = [rows[even_subset(table.direction[rows], int(n))] for rows, n in zip(of_sensor, shares, strict=True)]
        return replace(table.subset(np.sort(np.concatenate(chosen))), time_s=fire_times(count, DEFAULT_RATE_HZ))


class SpinningLayout(FixedLayout):
    """The rays of sensors that turn, whose channels were chosen on training scenes; see `selection.spinning`."""

    name = "spinning"
    chosen_on_scenes = True
    check_constraints = SelectedLayout.check_constraints
    leaves_rays_open = SelectedLayout.leaves_rays_open


LAYOUTS: Mapping[str, Layout] = {
    layout.name: layout
    for layout in (
        GridLayout(),
        DensityLayout(),
        ScanLayout(),
        DistributedLayout(),
        SelectedLayout(),
        SpinningLayout(),
        FixedLayout(),
    )
}


def layout_of(design: DesignSpec) -> Layout:
    """The layout of a design's rays."""
    return LAYOUTS[design.layout]


def gates_of(design: DesignSpec) -> Gates:
    """The gates that a design's rays have at any number of rays: as it says, else as its table tells, else as usual."""
    return design.gates or design.table_gates or layout_of(design).usual_gates


def own_count(design: DesignSpec) -> int:
    """The number of rays that a design was made for.

    Raises:
        ConfigError: The design leaves it open.
    """
    count = layout_of(design).own_count(design)
    if count is None:
        raise ConfigError("the design names no number of rays", where=design.name, hint="give --rays N")
    return count


def lay_out(
    design: DesignSpec,
    count: int | None = None,
    samples: Samples | None = None,
    *,
    gates: Gates | None = None,
    rate_hz: float = DEFAULT_RATE_HZ,
    seed: int = 0,
    at: Mapping[str, float] | None = None,
    retarget: Retarget | None = None,
) -> Rays:
    """The rays of a design.

    At the number of rays of its explicit table, the design's table is the answer, gates included. At others its layout
    says them; a scan of another number of rays is another fit, see `lidardesign.mixture.fit.refitted`.

    Arguments:
        design: The design.
        count: Rays per frame; None takes the design's own number.
        samples: Samples of the density, where rays or their gates follow from them.
        gates: `sensor` gives each ray its sensor's gate; `ray` the interval of the ranges seen around it; None is
            `gates_of` the design, its sensors' where there are no samples to find others by.
        rate_hz: Frames per second [Hz].
        seed: For the quantisation.
        at: Condition values, as {"x_m": 0.37}: a track gives its rays there, and any other design moves there as
            it is, see `track.placed`.
        retarget: log p* of design points (N, 6), where the samples are of a density with conditions.

    Raises:
        ConfigError: No number of rays is known, the layout at this count needs samples, or a track's place is
            not given.
    """
    total = own_count(design) if count is None else count
    for track in design.further_tracks:
        if len(track.sensor) == total:
            design = replace(design, track=track)
    # what moves was fitted where it was made: its rays are laid out there, then moved
    home = (at or {}) if design.track is not None else {**(at or {}), **design.at}
    here = placed(design, home) if home or design.track is not None else design
    if total == 0:
        rays = Rays(np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 2)), np.empty(0), np.empty(0))
    elif here.ray_table is not None and len(here.ray_table) == total:
        rays = here.ray_table
    else:
        layout = layout_of(here)
        if gates is None:
            gates = gates_of(design) if samples is not None or layout.extends_origins else "sensor"
        if samples is not None and samples.space.conditioned:
            # where the sensors alone will do, samples that cannot be moved are left out
            asked = layout.uses_samples if retarget is not None else layout.needs_samples
            samples = conditioned(samples, home, retarget) if asked(here, total, gates) else None
        rays = layout.lay_out(here, total, samples, gates, seed)
    if rate_hz != DEFAULT_RATE_HZ:
        rays = replace(rays, time_s=fire_times(total, rate_hz))
    return moved(rays, design, at) if at and design.track is None else rays
