"""Proposals: drawn from the density that they state, in spaces with free and with fixed angles."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh
from support import references

from lidardesign.density.objective.proposals import occluded_share, propose
from lidardesign.scenes.scene import Body, Box, Mesh, Plane, Scene, Sphere, rigid
from lidardesign.space import AZIMUTH, ELEVATION, RANGE, DesignSpace, direction

SPREAD_M = 0.05
BALL = Scene((Body(Sphere(0.5), poses=rigid(translation_m=(2.0, 0, 0))),))
TWO = Scene(
    (
        Body(Sphere(0.3), poses=rigid(translation_m=(1.5, 0.4, 0))),
        Body(Box((0.2, 0.4, 0.3)), poses=rigid(translation_m=(2.0, -0.3, 0.1))),
    )
)
FIXED_ORIGIN = DesignSpace((0, 0, 0, -0.5, -0.5, 0.5), (0, 0, 0, 0.5, 0.5, 3.5))
FLATLAND = DesignSpace((-0.5, 0, 0, -0.6, 0, 0.2), (0.5, 0, 0, 0.6, 0, 3.0))
FREE_ORIGIN = DesignSpace((-0.2, -0.2, 0, -0.6, -0.6, 0.5), (0.2, 0.2, 0, 0.6, 0.6, 3.5))


def drawn(scenes, space, count=20_000, seed=0):
    return propose(scenes, space, count, SPREAD_M, np.random.default_rng(seed))


def test_the_density_on_a_sphere_has_its_closed_form():
    proposals = drawn([BALL], FIXED_ORIGIN, 4000)
    v = direction(proposals.points[:, AZIMUTH], proposals.points[:, ELEVATION])
    along = v @ [2.0, 0, 0]
    chord = np.sqrt(0.25 - (4.0 - along**2))
    cosine = chord / 0.5
    steep = cosine > 0.05
    expected = np.zeros(len(v))
    for crossing in (along - chord, along + chord):
        z = (proposals.points[:, RANGE] - crossing) / SPREAD_M
        expected += crossing**2 / (math.pi * cosine) * np.exp(-(z**2) / 2)
    assert steep.mean() > 0.9
    np.testing.assert_allclose(proposals.log_density[steep], np.log(expected[steep]), atol=1e-6)


SETTINGS = {
    "fixed origin": ([BALL, TWO], FIXED_ORIGIN),
    "free origin": ([TWO], FREE_ORIGIN),
    "angles fixed": ([BALL, TWO], FLATLAND),
    "angles as the chart": ([BALL, TWO], DesignSpace(FIXED_ORIGIN.low, FIXED_ORIGIN.high, measure="angles")),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_proposals_have_the_density_that_they_state(name):
    scenes, space = SETTINGS[name]
    proposals = drawn(scenes, space, 40_000)
    unit = space.to_unit(proposals.points)
    # weighted by the inverse density, proposals fill their support evenly: halves of a cell with
    # surfaces all over it must weigh the same; narrow tubes around the ray to the ball's centre have full support
    free = [i for i in space.free if i != RANGE]
    centre = space.to_unit(np.array([[0.0, 0, 0, 0.0, 0.0, 1.5]]))[0]
    angular = [k for k, i in enumerate(space.free) if i in free and i in (AZIMUTH, ELEVATION)]
    tube = np.abs(unit[:, angular] - centre[angular]).max(axis=1) < 0.12
    near = np.abs(proposals.points[:, RANGE] - proposals.surface_range_m) < 2 * SPREAD_M
    kept = np.flatnonzero(tube & near & (proposals.column == 0))
    assert len(kept) > 200
    for k in angular:
        halves, weight = (unit[kept, k] > centre[k]).astype(int), np.exp(-proposals.log_density[kept])
        total, squares = np.bincount(halves, weight), np.bincount(halves, weight**2)
        assert abs(total[0] - total[1]) < references.STANDARD_ERRORS * math.sqrt(squares.sum())


def shell(points):
    """A function that lives around the ball's near side: even across rays, Gaussian in range."""
    v = direction(points[:, AZIMUTH], points[:, ELEVATION])
    closest = points[:, :3] + v * ((np.array([2.0, 0, 0]) - points[:, :3]) * v).sum(axis=1)[:, None]
    inside = np.linalg.norm(closest - [2.0, 0, 0], axis=1) < 0.4
    half_chord = np.sqrt(np.maximum(0.25 - np.square(closest - [2.0, 0, 0]).sum(axis=1), 0))
    first = np.linalg.norm(closest - points[:, :3], axis=1) - half_chord
    return inside * np.exp(-np.square((points[:, RANGE] - first) / SPREAD_M) / 2)


@pytest.mark.parametrize("space", [FIXED_ORIGIN, FLATLAND, FREE_ORIGIN])
def test_proposals_lie_in_the_space_within_eight_range_errors_of_their_surface(space):
    proposals = drawn([BALL, TWO], space, 2000)
    assert space.contains(proposals.points).all()
    assert np.abs(proposals.points[:, RANGE] - proposals.surface_range_m).max() < 8 * SPREAD_M
    assert np.isfinite(proposals.log_density).all()
    assert set(proposals.column) == {0, 1}


ARC = DesignSpace((-0.5, 0, 0, -0.6, 0, 1.6), (0.5, 0, 0, 0.6, 0, 1.6))
CAP = DesignSpace((0, 0, 0, -0.6, -0.6, 1.6), (0, 0, 0, 0.6, 0.6, 1.6))


@pytest.mark.parametrize(
    ("space", "side"),
    [(ARC, 0), (CAP, AZIMUTH), (FREE_ORIGIN, 0)],
    ids=["rays traced", "points aimed at", "a free range"],
)
def test_importance_sums_match_plain_integration(space, side):
    proposals = drawn([BALL], space, 200_000)
    assert len(proposals.points) > 1000
    assert (proposals.points[:, RANGE] == 1.6).all() == (space is not FREE_ORIGIN)

    def right_part(points, weights):
        # right of the middle third, where the ball's near side is 1.5 to 1.7 m away
        part = points[:, side] > 0.05
        terms = weights * shell(points)
        share = (terms * part).sum() / terms.sum()
        return share, np.sqrt(np.square(terms * (part - share)).sum()) / terms.sum()

    found, error = right_part(proposals.points, np.exp(-proposals.log_density))
    plain = space.sample(400_000, np.random.default_rng(9))
    truth, rest = right_part(plain, np.ones(len(plain)))
    assert abs(found - truth) < references.STANDARD_ERRORS * math.hypot(error, rest)


def test_no_mesh_proposal_has_an_unbounded_weight():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    mesh = Scene((Body(Mesh(ball.vertices + np.array([2.0, 0, 0]), np.asarray(ball.faces))),))
    exact, meshed = drawn([BALL], FIXED_ORIGIN, 5000), drawn([mesh], FIXED_ORIGIN, 5000)
    assert len(meshed.points) > 0.99 * len(exact.points)
    assert meshed.log_density.min() > exact.log_density.min() - 2.0


def test_moving_bodies_are_proposed_in_all_their_frames():
    poses = np.stack([rigid(translation_m=(2.0, y, 0)) for y in (-0.4, 0.4)])
    proposals = drawn([Scene((Body(Sphere(0.1), poses=poses),))], FIXED_ORIGIN, 2000)
    assert proposals.columns == [(0, 0), (0, 1)]
    for column, side in ((0, -1), (1, 1)):
        assert (np.sign(proposals.points[proposals.column == column, AZIMUTH]) == side).all()


@pytest.mark.parametrize("role", ["occluder", "target", "both"])
def test_the_occluded_share_counts_occluders_in_front_and_nothing_else(role):
    plate = Body(Box((0.005, 1.0, 1.0)), "plate", role, rigid(translation_m=(1.0, 0, 0)))
    wall = Body(Plane(), "wall", "both", rigid(np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), (2.0, 0, 0)))
    scene = Scene((wall, plate))
    share = occluded_share([scene], drawn([scene], FIXED_ORIGIN, 1000), 0.02)
    if role == "target":
        assert share < 0.02
    else:
        assert share > 0.2
