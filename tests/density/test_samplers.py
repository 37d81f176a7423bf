"""Every sampler draws from the density that it claims: Pearson's test on grids, as renderers do."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from support.baselines import problem_of, rays_of
from support.chi_square import UNLIKELY, counts_of_cells, mass_of_cells, p_value
from support.designs import sensor
from support.flows import flow_of
from support.mixtures import POINT, features_of, random_mixture
from support.mixtures import drawn as drawn_from_mixture
from support.spaces import log_volume

from lidardesign.constraints.document import Constraints
from lidardesign.density.coordinates import Coordinates
from lidardesign.density.objective.visibility import Optics
from lidardesign.density.training.learned import FlatTarget
from lidardesign.density.training.losses import Pool
from lidardesign.density.training.sampling import draw_samples, log_density_of, log_prob_of_unit
from lidardesign.methods.occupancy import OccupancyGrid
from lidardesign.mixture.bounds import sensor_groups
from lidardesign.mixture.components import log_density
from lidardesign.mixture.support import pin_samples, restrict_samples
from lidardesign.numerics import systematic_draw
from lidardesign.samples import Samples
from lidardesign.sensors.pattern import even_rays, low_discrepancy
from lidardesign.sensors.sensor import tangent_coordinates
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, angles, direction

DRAWS = 20_000


def assert_drawn(points, edges, density, inside, whole=True):
    """Draws have a density over cells, each known from so many midpoints per axis; the cells hold all of it."""
    mass = mass_of_cells(density, edges, inside)
    assert not whole or mass.sum() == pytest.approx(1.0, abs=5e-3)
    assert p_value(counts_of_cells(points, edges), len(points) * mass / mass.sum()) > UNLIKELY


def edges_of(*sizes, low=-1.0, high=1.0):
    return [np.linspace(low, high, size + 1) for size in sizes]


# --- the flow

# cells per axis, midpoints per cell and axis, and how far the flow's weights are scaled up: densities vary by factors
# of 30 to 300, and by so little within a midpoint's part that its error is far below the draws' noise
GRIDS = {
    "one dimension": ([60], 64, 5.0),
    "one on a circle": ([60], 64, 5.0),
    "two dimensions": ([16, 16], 12, 4.0),
    "circle, then two": ([8, 8, 8], 6, 3.0),
    "one, given one": ([60], 64, 4.0),
    "three, given two": ([8, 8, 8], 6, 3.0),
}


def of_flow(flow, context):
    def density(points):
        given = None if context is None else context.expand(len(points), -1)
        with torch.no_grad():
            return flow.log_prob(torch.as_tensor(points), given).exp().numpy()

    return density


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", GRIDS)
def test_samples_of_a_flow_have_its_integrated_density(name, dtype):
    sizes, inside, scale = GRIDS[name]
    flow = flow_of(name, layers=2, scale=scale)
    context = torch.tensor([[0.3, -0.8][: flow.context]], dtype=torch.float64) if flow.context else None
    base = flow.draw(DRAWS, torch.Generator().manual_seed(2))[0].to(dtype)
    with torch.no_grad():
        single = flow_of(name, layers=2, scale=scale).to(dtype)
        values, _ = single(base, None if context is None else context.to(dtype).expand(DRAWS, -1))
    assert_drawn(values.double().numpy(), edges_of(*sizes), of_flow(flow, context), inside)


def learned_in(space, seed=4):
    flow = flow_of("circle, then two", layers=2, scale=3.0)
    target = FlatTarget(Optics(0.1, 1e3, 1e3, 0.1), space)
    return SimpleNamespace(
        flow=flow, target=target, coordinates=Coordinates(space), generator=torch.Generator().manual_seed(seed)
    )


@pytest.mark.parametrize("measure", ["solid_angle", "angles"])
def test_samples_of_a_run_have_the_density_per_chart_volume_that_is_stored_with_them(measure):
    space = DesignSpace((0, 0, 0, 1.0, -0.9, 0.5), (0, 0, 0, 1.0 + 2 * math.pi, 1.2, 3.0), measure=measure)
    learned = learned_in(space)
    samples = draw_samples(learned, DRAWS)
    np.testing.assert_allclose(log_density_of(learned, samples.points), samples.log_prob, atol=1e-6)
    low, high = space.chart_low[3:], space.chart_high[3:]
    edges = [np.linspace(a, b, 9) for a, b in zip(low, high, strict=True)]

    def density(chart):
        points = space.from_chart(np.column_stack([np.zeros((len(chart), 3)), chart]))
        return np.exp(log_density_of(learned, points))

    assert_drawn(np.clip(space.to_chart(samples.points)[:, 3:], low, high), edges, density, 6)


def test_conditions_and_proposals_are_drawn_as_they_say():
    generator = torch.Generator().manual_seed(5)
    conditions = flow_of("three, given two").draw(DRAWS, generator)[1].numpy()
    edges = edges_of(10, 10)
    assert p_value(counts_of_cells(conditions, edges), np.full(100, DRAWS / 100)) > UNLIKELY
    log_weights = np.random.default_rng(6).normal(0, 2, 400)
    pool = Pool.of(np.arange(400.0)[:, None], log_weights, np.zeros(400))
    share = np.exp(log_weights) / np.exp(log_weights).sum()
    emphasis = np.random.default_rng(7).uniform(1, 20, 400)
    for emphasised in (pool, replace(pool, emphasis=torch.as_tensor(emphasis))):
        unit, values, weights = emphasised.draw(DRAWS, generator, torch.zeros(1, dtype=torch.float64))
        chosen = unit[:, 0].long().numpy()
        np.testing.assert_array_equal(values.numpy(), log_weights[chosen])
        drawn = share * emphasised.emphasis.numpy()
        assert p_value(np.bincount(chosen, minlength=400), DRAWS * drawn / drawn.sum()) > UNLIKELY
        # with their weights they stand for the target again
        np.testing.assert_allclose(weights.numpy() * (drawn / drawn.sum())[chosen], share[chosen])


def test_proposals_are_drawn_by_what_the_flow_starves():
    learned = learned_in(DesignSpace((0, 0, 0, 1.0, -0.9, 0.5), (0, 0, 0, 1.0 + 2 * math.pi, 1.2, 3.0)))
    unit = np.random.default_rng(8).uniform(-1, 1, (4000, 3))
    log_prob = log_prob_of_unit(learned.flow, learned.coordinates, torch.as_tensor(unit)).numpy()
    # a target that is the flow but for a corner, which is a hundred times as dense
    corner = (unit > 0.2).all(axis=1)
    log_target = log_prob + np.where(corner, math.log(100.0), 0.0)
    pool = Pool.of(unit, log_target, np.zeros(len(unit)))
    emphasis = pool.emphasised(learned.flow, learned.coordinates).emphasis.numpy() - 1
    np.testing.assert_allclose(emphasis[corner] / emphasis[~corner].mean(), 100.0, rtol=1e-4)
    assert pool.weights.numpy() @ (1 / emphasis) == pytest.approx(1.0, rel=1e-4)


# --- mixtures and single sensors


def of_directions(density_of_points, origin=(0.0, 0.0, 0.0)):
    """A density over (azimuth, sin elevation, range) of one over design points."""
    return lambda chart: density_of_points(
        np.column_stack([np.tile(origin, (len(chart), 1)), chart[:, 0], np.arcsin(chart[:, 1]), chart[:, 2]])
    )


# of standard deviations of up to 0.7 rad: t / sin t, the tangent plane's own share, is then up to 1.5 and more
SPHERE_EDGES = [np.linspace(0, 2 * math.pi, 17), np.linspace(-1, 1, 13), np.linspace(0, 9, 7)]


def test_draws_of_a_mixture_over_the_sphere_have_its_density_per_solid_angle():
    generator = np.random.default_rng(7)
    mixture = random_mixture(generator, 3, width=0.8)
    points = drawn_from_mixture(mixture, DRAWS, generator, POINT)
    chart = np.column_stack([points[:, AZIMUTH], np.sin(points[:, ELEVATION]), points[:, RANGE]])
    density = of_directions(lambda p: np.exp(log_density(mixture, features_of(p, POINT))))
    assert_drawn(chart, SPHERE_EDGES, density, 8)


# --- truncated sampling

BOX = DesignSpace((-0.5, -0.4, 0, -1.5, -0.9, 0.2), (0.5, 0.4, 0, 1.5, 0.9, 3.0))


def samples_of(log_p_star, space=BOX, count=400_000, seed=9):
    """Uniform samples weighted to p*: many more than are drawn of them, so that their own noise is little."""
    points = space.sample(count, np.random.default_rng(seed))
    return Samples(points, np.full(count, -log_volume(space)), log_p_star(points), space)


def bump(points):
    """log p* of a tilted hill in origin, direction and range."""
    x, y = points[:, 0], points[:, 1]
    azimuth, elevation, distance = points[:, AZIMUTH], points[:, ELEVATION], points[:, RANGE]
    return -np.square(x - 0.3 * azimuth) - y - np.square(azimuth - 0.2) - np.square(distance - 1 - elevation) + x * y


def restricted_draws(document, space=BOX, log_p_star=bump, count=8000):
    samples, constraints = samples_of(log_p_star, space), Constraints.from_mapping(document)
    (group,) = sensor_groups(constraints.rules, space, 1)
    support = restrict_samples(samples, constraints.rules, group)
    drawn = support.points[systematic_draw(support.weights, count, np.random.default_rng(10))]
    return support, drawn


def axis_mass(axes, edges, within, log_p_star=bump, space=BOX, count=400_000):
    """The renormalised density of p* in a region over the cells of some chart axes; a lattice sums over the others."""
    unit = np.mod(0.5 + np.arange(1, count + 1)[:, None] * _LATTICE[: len(space.free)], 1.0)
    points = space.from_unit(2 * unit - 1)
    chart = space.to_chart(points)
    share = np.where(within(points), np.exp(log_p_star(points)), 0.0)
    mass = np.histogramdd(chart[:, axes], edges, weights=share)[0].ravel()
    return mass / mass.sum(), share.mean() / np.exp(log_p_star(points)).mean()


# generators of a lattice in five dimensions: powers of the root of r^6 = r + 1, inverted (Roberts 2018)
_LATTICE = 1.1347241384015194 ** -np.arange(1.0, 6.0)


def test_draws_inside_a_gate_have_the_density_renormalised_there():
    support, drawn = restricted_draws({"gate": {"start_m": {"min": 0.8}, "end_m": {"max": 1.9}}})
    assert drawn[:, RANGE].min() >= 0.8
    assert drawn[:, RANGE].max() <= 1.9
    edges = [np.linspace(-1.5, 1.5, 9), np.linspace(0.8, 1.9, 12)]
    mass, share = axis_mass([AZIMUTH, RANGE], edges, lambda p: (p[:, RANGE] >= 0.8) & (p[:, RANGE] <= 1.9))
    assert support.total == pytest.approx(share, rel=0.01)
    assert p_value(counts_of_cells(drawn[:, [AZIMUTH, RANGE]], edges), len(drawn) * mass) > UNLIKELY


def test_draws_inside_an_origin_box_without_an_excluded_one_have_the_density_renormalised_there():
    hole = {"low_m": [0.0, 0.0, -1.0], "high_m": [0.2, 0.2, 1.0]}
    box = {"low_m": [-0.4, -0.2, 0.0], "high_m": [0.4, 0.4, 0.0]}
    support, drawn = restricted_draws({"origin": {**box, "exclude": [hole]}})
    edges = [np.linspace(-0.4, 0.4, 9), np.linspace(-0.2, 0.4, 7)]

    def within(points):
        x, y = points[:, 0], points[:, 1]
        inside = (x > 0) & (x < 0.2) & (y > 0) & (y < 0.2)
        return (np.abs(x) <= 0.4) & (y >= -0.2) & (y <= 0.4) & ~inside

    assert within(drawn).all()
    mass, share = axis_mass([0, 1], edges, within)
    assert support.total == pytest.approx(share, rel=0.01)
    assert p_value(counts_of_cells(drawn[:, :2], edges), len(drawn) * mass) > UNLIKELY


def test_draws_inside_a_field_of_view_fill_its_cap_of_the_sphere_evenly():
    # p* is flat and the boresight given: what is left is the cap around it, half a diagonal of the field wide
    _, drawn = restricted_draws(
        {
            "boresight": {"azimuth_deg": {"min": 20, "max": 20}, "elevation_deg": {"min": 10, "max": 10}},
            "field_of_view": {"horizontal_deg": {"max": 40}, "vertical_deg": {"max": 30}},
        },
        log_p_star=lambda points: np.zeros(len(points)),
    )
    axis = direction(math.radians(20), math.radians(10))
    cosine = direction(drawn[:, AZIMUTH], drawn[:, ELEVATION]) @ axis
    reach = math.cos(math.radians(math.hypot(40, 30) / 2))
    frame = np.stack([axis, direction(math.radians(110), 0.0), direction(math.radians(20), math.radians(100))])
    local = direction(drawn[:, AZIMUTH], drawn[:, ELEVATION]) @ frame.T
    edges = [np.linspace(reach, 1, 11), np.linspace(-math.pi, math.pi, 13)]
    found = counts_of_cells(np.column_stack([cosine, np.arctan2(local[:, 2], local[:, 1])]), edges)
    assert p_value(found, np.full(120, len(drawn) / 120)) > UNLIKELY


def test_draws_from_a_pinned_origin_have_the_density_at_that_origin():
    space = DesignSpace((-0.05, 0, 0, -0.8, -0.7, 0.5), (0.05, 0, 0, 0.8, 0.7, 2.0))

    # a hill so far inside the space that what is seen of it from one origin is seen from all
    def log_p_star(points):
        x, azimuth, elevation, distance = points[:, 0], points[:, AZIMUTH], points[:, ELEVATION], points[:, RANGE]
        return -np.square((azimuth - x) / 0.2) - np.square((elevation + x) / 0.2) - np.square((distance - 1.2) / 0.15)

    samples = samples_of(log_p_star, space)
    constraints = Constraints.from_mapping({"origin": {"fixed_m": [0.04, 0, 0]}})
    (group,) = sensor_groups(constraints.rules, space, 1)
    support = pin_samples(samples, constraints.rules, group, log_p_star, 60_000, np.random.default_rng(11))
    drawn = support.points[systematic_draw(support.weights, 4000, np.random.default_rng(12))]
    assert (drawn[:, 0] == 0.04).all()
    edges = [np.linspace(-0.8, 0.8, 15), np.linspace(-0.7, 0.7, 13), np.linspace(0.5, 2.0, 13)]
    chart = np.column_stack([drawn[:, AZIMUTH], np.sin(drawn[:, ELEVATION]), drawn[:, RANGE]])
    assert_drawn(chart, edges, of_directions(lambda p: np.exp(log_p_star(p)), (0.04, 0, 0)), 8, whole=False)


# --- rays


def field_mass(one, edges):
    """The mass over (azimuth, sin elevation) of an even density over one sensor's field in its tangent plane."""
    half = np.array(one.field_of_view_rad) / 2

    def on_sphere(chart):
        tangent = tangent_coordinates(one.frame, direction(chart[:, 0], np.arcsin(chart[:, 1])))
        angle = np.hypot(*tangent.T)
        inside = (np.abs(tangent) <= half).all(axis=1)
        return np.where(inside, 1 / np.sinc(angle / math.pi), 0.0)

    mass = mass_of_cells(on_sphere, edges, 12)
    return mass / mass.sum()


def on_chart(rays):
    azimuth, elevation = angles(rays.direction)
    return np.column_stack([azimuth, np.sin(elevation)])


CHART_EDGES = [np.linspace(0, 2 * math.pi, 33), np.linspace(-1, 1, 17)]


def test_even_rays_are_even_over_a_wide_field_of_view_on_the_sphere():
    one = sensor(spread_rad=(0.5, 0.3), azimuth_rad=2.0)
    mass = field_mass(one, CHART_EDGES)
    counts = counts_of_cells(on_chart(even_rays([one], [DRAWS])), CHART_EDGES)
    # the field's edge cuts cells, which midpoints know to a part in a few hundred
    filled = DRAWS * mass > 5
    assert p_value(counts[filled], counts[filled].sum() * mass[filled] / mass[filled].sum()) > UNLIKELY


@pytest.mark.parametrize("measure", ["solid_angle", "angles"])
@pytest.mark.parametrize("name", ["random", "uniform"])
def test_rays_of_the_plain_baselines_are_uniform_in_what_they_say(name, measure):
    space = DesignSpace((-1, 0, 0, 0.5, -1.2, 0.5), (1, 0, 0, 2.5, 1.4, 3.0), measure=measure)
    rays = rays_of(name, problem_of(space, (), 3, rays=4000))
    azimuth, elevation = angles(rays.direction)
    # even placements divide the angles; random ones are uniform in the space's own measure
    by_area = measure == "solid_angle" and name == "random"
    low, high = np.array([-1, 0.5, -1.2]), np.array([1, 2.5, 1.4])
    if by_area:
        low[2], high[2] = np.sin(low[2]), np.sin(high[2])
    edges = [np.linspace(*ends, 8) for ends in zip(low, high, strict=True)]
    chart = np.column_stack([rays.origin_m[:, 0], azimuth, np.sin(elevation) if by_area else elevation])
    assert p_value(counts_of_cells(np.clip(chart, low, high), edges), np.full(343, 4000 / 343)) > UNLIKELY


def test_points_of_an_occupancy_grid_are_drawn_by_its_probabilities():
    probability = np.random.default_rng(15).uniform(0, 1, (4, 3, 5)) ** 2
    grid = OccupancyGrid(np.array([1.0, -2.0, 0.5]), 0.25, probability)
    points = grid.draw(DRAWS, np.random.default_rng(16))
    edges = [low + 0.25 * np.arange(n + 1) for low, n in zip(grid.low_m, probability.shape, strict=True)]
    expected = DRAWS * probability.ravel() / probability.sum()
    assert p_value(counts_of_cells(points, edges), expected) > UNLIKELY


@pytest.mark.parametrize("count", [400, 1000, 20_000])
@pytest.mark.parametrize("axes", [2, 3, 4, 5, 6])
def test_even_points_are_more_even_than_draws_in_every_pair_of_their_axes(axes, count):
    points = low_discrepancy(count, axes)
    assert points.shape == (count, axes)
    edges = edges_of(10, 10, low=0.0)
    for first in range(axes):
        for second in range(first):
            counts = counts_of_cells(points[:, [second, first]], edges)
            # Pearson's statistic of independent draws falls below this once in a hundred times
            assert np.sum(np.square(counts - count / 100)) / (count / 100) < chi2.ppf(0.01, 99), (second, first)
