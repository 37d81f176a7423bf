"""Naive float64 twins and closed forms that tests compare with, and the tolerances with their reasons."""

from __future__ import annotations

import functools
import math

import numpy as np

from lidardesign.samples import Samples
from lidardesign.space import DesignSpace

# trilinear interpolation of a smooth distance is off by about h^2 / 4 (measured: 6.3e-4 at h = 1/64 of a unit sphere)
GRID_ERROR_PER_STEP_SQUARED = 0.5
# float32 tables carry 1.2e-7 relative rounding, central differences over 1e-4 m turn it into about 1e-3
TABLE_GRADIENT = 5e-3


def naive_log_target(points, scene_distances, log_weights, sigma_m, log_transmittance=None):
    """log p* by plain loops: points (N, 6), functions of one scene point each, one per scene."""
    values = []
    for point in points:
        x, y, z, azimuth, elevation, reach = point
        place = np.array(
            [
                x + reach * math.cos(elevation) * math.cos(azimuth),
                y + reach * math.cos(elevation) * math.sin(azimuth),
                z + reach * math.sin(elevation),
            ]
        )
        terms = []
        for index, distance in enumerate(scene_distances):
            term = log_weights[index] - distance(place) ** 2 / (2 * sigma_m**2)
            terms.append(term + (0.0 if log_transmittance is None else log_transmittance(index, point)))
        peak = max(terms)
        values.append(peak + math.log(sum(math.exp(term - peak) for term in terms)))
    return np.array(values)


def sphere_distance(centre, radius):
    """The signed distance of a sphere as a function of one point."""
    return lambda place: float(np.linalg.norm(place - np.asarray(centre)) - radius)


def numerical_gradient(function, points, step):
    """Central differences of a function of (N, K) points that gives (N,), shape (N, K)."""
    columns = []
    for k in range(points.shape[1]):
        offset = np.zeros(points.shape[1])
        offset[k] = step
        columns.append((function(points + offset) - function(points - offset)) / (2 * step))
    return np.stack(columns, axis=1)


# a few roundings of numbers near 1
ROUNDING = 1e-15
# |estimate - truth| of a fixed seed is below four standard errors but for one draw in 16,000
STANDARD_ERRORS = 4.0
# Embree's float32, recentred: 6e-8 relative per operation, a few of them, for scenes of about a metre
EMBREE_M = 2e-6


def shape_distance(shape):
    """The signed distance of a shape at rest as a function of (N, 3) points; of a mesh, of its one triangle's plane."""
    name = type(shape).__name__
    if name == "Sphere":
        return lambda q: np.linalg.norm(q, axis=1) - shape.radius_m
    if name == "Plane":
        return lambda q: q[:, 2]
    if name == "Capsule":
        half = shape.half_length_m
        return lambda q: np.linalg.norm(q - np.c_[0 * q[:, :2], np.clip(q[:, 2], -half, half)], axis=1) - shape.radius_m
    if name == "Cylinder":
        return lambda q: _corner_distance(
            np.stack([np.hypot(q[:, 0], q[:, 1]) - shape.radius_m, np.abs(q[:, 2]) - shape.half_length_m], axis=1)
        )
    if name == "Ellipsoid":
        return lambda q: ellipsoid_distance(np.array(shape.semi_axes_m), q)
    if name == "Box":
        half = np.array(shape.half_extents_m)
        return lambda q: _corner_distance(np.abs(q) - half)
    a, b, c = shape.vertices[shape.faces[0]]
    normal = np.cross(b - a, c - a)
    return lambda q: (q - a) @ (normal / np.linalg.norm(normal))


def _corner_distance(beyond):
    """The distance from how far points are beyond each of the sides that meet in a right corner, (N, K)."""
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)


def ellipsoid_distance(axes, points, halvings=1200):
    """The signed distance of an ellipsoid by halving what the root lies in (Eberly 2013)."""
    place = np.maximum(np.abs(points), 1e-15 * axes)
    square = axes**2

    def beyond(t):
        return ((axes * place / (t[:, None] + square)) ** 2).sum(axis=1) > 1

    low = np.full(len(points), -square.min())
    high = np.linalg.norm(axes * place, axis=1)
    for _ in range(halvings):
        middle = (low + high) / 2
        if ((middle == low) | (middle == high) | (high - low < 1e-20 * square.min())).all():
            break
        is_beyond = beyond(middle)
        low, high = np.where(is_beyond, middle, low), np.where(is_beyond, high, middle)
    nearest = square * place / ((low + high)[:, None] / 2 + square)
    inside = ((points / axes) ** 2).sum(axis=1) < 1
    return np.where(inside, -1.0, 1.0) * np.linalg.norm(nearest - np.abs(points), axis=1)


def marched_hit(distance, origins, directions, reach, steps=400):
    """First hits by sphere marching of an exact distance, from outside; inf where the reach is passed first."""
    travelled = np.zeros(len(origins))
    for _ in range(steps):
        travelled += np.maximum(distance(origins + travelled[:, None] * directions), 0.0)
        travelled = np.minimum(travelled, 2 * reach)
    return np.where(travelled < reach, travelled, np.inf)


# a spline of slope 1e4 multiplies float64's 1e-16 by its slope and its curvature, over a few layers
FLOW_ROUND_TRIP_NATS = 1e-6
# distances of a scene of a metre are off by 1e-7 (float32) to 1e-6 m (vertices 1e7 m away, grids that cut cells apart
# by rounding); over sigma = 0.05 m and up to ten sigma away that is 2e-3 nats
SCALED_NATS = 5e-3


def naive_sphere_log_transmittance(centre, radius, point, optics):
    """log T of one design point behind one sphere: beta times what lies beyond the first hit, less the margin."""
    x, y, z, azimuth, elevation, reach = point
    origin = np.array([x, y, z])
    ray = np.array(
        [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    )
    offset = origin - np.asarray(centre)
    half = float(offset @ ray)
    discriminant = half**2 - float(offset @ offset) + radius**2
    if discriminant < 0:
        return 0.0
    roots = [root for root in (-half - math.sqrt(discriminant), -half + math.sqrt(discriminant)) if root >= 0]
    if not roots:
        return 0.0
    return -optics.attenuation_per_m * max(0.0, reach - optics.margin_m - min(roots))


def recursive_frechet(first, second):
    """The discrete Frechet distance by its recursive definition (Eiter and Mannila 1994)."""

    @functools.cache
    def leash(i, j):
        apart = math.dist(first[i], second[j])
        before = [leash(a, b) for a, b in ((i - 1, j), (i, j - 1), (i - 1, j - 1)) if a >= 0 and b >= 0]
        return max(apart, min(before)) if before else apart

    return leash(len(first) - 1, len(second) - 1)


def quarter_turned(samples):
    """The same world seen from a frame turned by 90 degrees about the vertical."""
    points = samples.points.copy()
    points[:, 0], points[:, 1] = -samples.points[:, 1], samples.points[:, 0]
    points[:, 3] += math.pi / 2
    low, high = list(samples.space.low), list(samples.space.high)
    low[0], high[0], low[1], high[1] = -high[1], -low[1], low[0], high[0]
    low[3], high[3] = low[3] + math.pi / 2, high[3] + math.pi / 2
    return Samples(points, samples.log_prob, samples.log_target, DesignSpace(tuple(low), tuple(high)))


def naive_counts_with_dead_time(pulse_of_photon, bin_of_photon, bins, dead_bins, period_bins):
    """Counts per bin by following photons through time one after the other; of a pulse's photons in one bin, one."""
    counts = [0] * bins
    alive_at = -math.inf
    for pulse, place in sorted(zip(pulse_of_photon, bin_of_photon, strict=True)):
        time = pulse * period_bins + place
        if time >= alive_at:
            counts[place] += 1
            alive_at = time + max(dead_bins, 1)
    return np.array(counts)


def first_photon_distribution(arriving):
    """p_i = (1 - exp(-l_i)) prod_{j<i} exp(-l_j) of expected photons per pulse and bin (B,); the last is for none."""
    survived, shares = 1.0, []
    for expected in arriving:
        shares.append(survived * (1 - math.exp(-expected)))
        survived *= math.exp(-expected)
    return np.array([*shares, survived])


# an edge or a vertex belongs to the triangles around it: barycentric coordinates are off by a few roundings
ON_EDGE = 1e-9


def naive_mesh_hit(vertices, faces, origins, directions):
    """First hits of rays of unit length by Moeller and Trumbore (1997) in float64, every ray with every triangle."""
    corner, first, second = (vertices[faces[:, 0]], *(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    nearest = np.full(len(origins), np.inf)
    for index, (origin, ray) in enumerate(zip(origins, directions, strict=True)):
        across = np.cross(ray, second)
        volume = np.einsum("fk,fk->f", first, across)
        usable = volume != 0
        inverse = 1 / np.where(usable, volume, 1.0)
        offset = origin - corner
        u = np.einsum("fk,fk->f", offset, across) * inverse
        turned = np.cross(offset, first)
        v = turned @ ray * inverse
        reach = np.einsum("fk,fk->f", second, turned) * inverse
        inside = usable & (u >= -ON_EDGE) & (v >= -ON_EDGE) & (u + v <= 1 + ON_EDGE) & (reach >= 0)
        nearest[index] = np.where(inside, reach, np.inf).min(initial=np.inf)
    return nearest


def naive_crossings(vertices, faces, points, looking):
    """How many triangles the rays from points (N, 3) along one direction cross, (N,): every one, by its plane."""
    a, b, c = np.moveaxis(np.asarray(vertices, float)[faces], 1, 0)
    normal = np.cross(b - a, c - a)
    along = normal @ looking
    counts = np.zeros(len(points), dtype=int)
    for number, point in enumerate(points):
        with np.errstate(divide="ignore", invalid="ignore"):
            travelled = np.einsum("fk,fk->f", normal, a - point) / along
        met = point + travelled[:, None] * looking
        inside = travelled > 0
        for start, end in ((a, b), (b, c), (c, a)):
            inside &= np.einsum("fk,fk->f", np.cross(end - start, met - start), normal) >= 0
        counts[number] = inside.sum()
    return counts
