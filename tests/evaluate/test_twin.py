"""The design without visibility: the same fit to other samples, in every layout."""

import math
from dataclasses import replace

import numpy as np
from lidardesign.layouts.rays import lay_out
from support.tables import each_row

from lidardesign.constraints.check import check_design
from lidardesign.constraints.document import Constraints
from lidardesign.mixture.fit import fit, rays_at
from lidardesign.samples import Samples
from lidardesign.scoring.baselines.candidates import mean_mbps
from lidardesign.scoring.baselines.simple import TwinCandidate, fitted_twin
from lidardesign.sensors.bandwidth import Bandwidth
from lidardesign.sensors.design_file import design_document
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
CEILING = DesignSpace((-1, -1, 1, 0, -math.pi / 2, 0.1), (1, 1, 1, 2 * math.pi, -1.0, 2.0))
AISLE = DesignSpace(
    (-0.5, 0.0, 0.0, -math.pi / 2, 0.0, 0.1), (4.0, 0.0, 0.0, -math.pi / 2, math.pi / 2, 5.0), condition=("x_m",)
)
LIMITS = {"gate": {"width_m": {"max": 0.3}}, "budget": {"rays": 24}}


def samples(space, centre, seed):
    """Samples about a centre, equally weighted."""
    generator = np.random.default_rng(seed)
    spread = 0.08 * (np.array(space.high) - np.array(space.low))
    points = generator.normal(centre, spread, (8_000, 6))
    points[:, list(space.conditioned)] = space.sample(8_000, generator)[:, list(space.conditioned)]
    fixed = [axis for axis in range(6) if axis not in space.free]
    points[:, fixed] = np.array(space.low)[fixed]
    points = points[space.contains(points)]
    return Samples(points, np.zeros(len(points)), np.zeros(len(points)), space)


CASES = {
    "grid": (SPACE, {"sensors": 3, "layout": "grid"}, LIMITS),
    "density": (SPACE, {"sensors": 2, "layout": "density", "rays": 24}, LIMITS),
    "gates per ray": (SPACE, {"sensors": 2, "layout": "density", "rays": 24, "gates": "ray"}, LIMITS),
    "scan": (SPACE, {"layout": "scan", "rays": 24}, LIMITS),
    "distributed": (CEILING, {"sensors": 3, "layout": "distributed", "rays": 24}, LIMITS),
    "track": (AISLE, {"layout": "scan", "rays": 6}, {}),
}
CENTRES = {
    "SPACE": ((0, 0, 0, 0.1, 0.0, 2.0), (0, 0, 0, -0.2, 0.1, 2.5)),
    "CEILING": ((0.2, 0.1, 1, 2.0, -1.3, 1.0), (-0.3, 0.2, 1, 3.0, -1.2, 1.2)),
    "AISLE": ((0, 0, 0, 0, 0.6, 1.2), (0, 0, 0, 0, 0.9, 1.6)),
}


def both(case):
    """A design, and its twin fitted to samples about another centre."""
    space, choices, limits = CASES[case]
    name = next(name for name, value in globals().items() if value is space)
    own, other = (samples(space, centre, seed) for seed, centre in enumerate(CENTRES[name]))
    constraints = Constraints.from_mapping(limits, where="constraints")
    design = fit(own, constraints=constraints, seed=5, name="own", **choices).design
    return replace(design, provenance={"seed": 5}), own, other, choices


@each_row("case", CASES)
def test_a_twin_has_as_many_sensors_and_rays_and_keeps_the_same_constraints(case):
    design, _, other, _ = both(case)
    twin = fitted_twin(design, other, name="no-visibility")
    assert twin.name == "no-visibility"
    assert len(twin.sensors) == len(design.sensors)
    assert twin.layout == design.layout
    assert twin.rays == design.rays
    assert (twin.track is None) == (design.track is None)
    assert (twin.ray_table is None) == (design.ray_table is None)
    limits = Constraints.from_mapping(CASES[case][2], where="constraints")
    assert all(check.satisfied for check in check_design(design_document(twin), limits, CASES[case][0]))
    for at in ({"x_m": 0.37}, {"x_m": 3.91}) if case == "track" else ({},):
        rays = lay_out(twin, design.rays or 24, other, at=at)
        assert len(rays) == (design.rays or 24)


@each_row("case", CASES)
def test_a_twin_of_the_same_samples_is_the_design_itself(case):
    design, own, _, _ = both(case)
    twin = fitted_twin(design, own, name="again")
    written = [replace(one, name="same", provenance={}) for one in (design, twin)]
    assert design_document(written[0]) == design_document(written[1])


@each_row(("case", "limit"), [("grid", 0.0), ("grid", 0.5), ("grid", 9.0), ("scan", 0.0), ("scan", 0.3)])
def test_a_twin_within_a_bandwidth_never_exceeds_it(case, limit):
    design, own, _, _ = both(case)
    calls = []

    def counted(one, count, samples, *, at=None):
        calls.append(count)
        return rays_at(one, count, samples, at=at)

    candidate = TwinCandidate(design, own, [{}], counted)
    positions = candidate.positions_within([SPACE], limit, Bandwidth())
    assert mean_mbps(positions, Bandwidth()) <= limit
    assert len(calls) == len(set(calls)) <= 10
    if limit == 0.0:
        assert len(positions[0]) == 0
