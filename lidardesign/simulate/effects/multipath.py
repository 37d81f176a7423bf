"""Multipath: echoes by way of other surfaces, rendered by the light-transport simulator.

The indirect light that a receiver gets depends on the emission and on what its pixels see:

- A *flood* lights all rays' spots at once, and each pixel sees its own: light goes from the emitter to Q, to P and
  back, and pixel n sees its spot P, which all other spots Q light too. The spots are the lights, matt points with the
  power that they reflect (Keller 1997, Instant radiosity), so that only the design's rays emit light. Where pixels
  overlap, each receives its own ray's part of indirect light, as of direct light.
- A *scanned* beam lights one spot P, and its pixel sees a cone around the beam: light comes back by P, Q, P and, where
  Q lies in that cone, by P, Q. The beam's own spot is the only light, viewed along rays spread in the cone. A pixel
  without a solid angle receives no indirect light.
- A *fixed receiver* gets a scanned beam's paths P, Q from all Q in its field of view. By reciprocity light is sent from
  the receiver instead, and the radiance along the beam is its gain.

A detector with perfect resolution that counts no photons (`ideal`) takes no late light for an echo, even without a
direct one.

Paths have up to `MOST_SURFACES` surfaces. A spot has a size, within which its light grows no stronger: without it, the
few paths that end next to a spot in a crease would have unbounded weights; light within a spot's own size is part of
its direct echo. Beams are thin, and bodies are static within a frame. Mirrors and glass are left to `specular`: here
they absorb all light that they do not scatter, so that none is received twice. Light that is earlier than a ray's
direct echo by more than the distance between emitters (from nearer surfaces at the edge of its pixel) is left out.
Estimates are unbiased up to that; their noise falls with the root of `PATHS`, which all rays share.

Echoes are the simulator's bins of half path, a quarter of the detector's resolution where no more than `MOST_CELLS` of
them reach to the gates' ends. They name the body of the ray's first hit, whose echo they disturb.

Bound of its effect (`bound`): rays cast from hit points find other surfaces, and the light that these send back is
bounded (`light_transport.detours`): for a flood or a fixed receiver, the light that reaches them; for a scanned pixel,
the light that falls on its own spot again. Light late by less than the detector's resolution moves the echo by its
delay times its share; later light makes a peak of its own, which is taken for the echo at most where all of it
outweighs the echo. Where a bistatic receiver does not receive the echo at all, any indirect light may be taken for it.

Where a flood lights all spots at once, other rays' spots send light to a ray's own. All rays have the same power. Ray j
lights a spot Q at the distance R_j, which sends rho_Q of it on; a spot P of the area A, seen by pixel i, gets rho_Q cos
cos A / (pi d^2) of what its own ray gives it, late by (R_j + d - R_i) / 2 of half path. Further bounces bring at most 1
/ (1 - rho) times as much in all, rho the largest reflectance (energy is kept; a geometric series). Occlusion between
spots is ignored, and beams are taken to end on them: where only part of a wide beam does, its own light is weaker than
assumed here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidardesign.numerics import EPSILON_FLOAT32, safe_divide
from lidardesign.scenes.casting import shared_caster
from lidardesign.scenes.rays import Hits, Rays, in_view, path_windows
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.light import Beams, Echoes, direct_echoes, reflectances
from lidardesign.simulate.detector.physics import Detector, Physics, resolution_m
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import EffectBound, FirstHits
from lidardesign.simulate.light_transport.detours import MOST_POINTS, WHITEST, Detours, lamp_bound, pixel_bound
from lidardesign.simulate.light_transport.transport import Lights, PathBins, Transients, render_transient

MOST_SURFACES = 6
# Light paths of a frame, all rays together: about a second.
PATHS = 1 << 19
FEWEST_SAMPLES, MOST_SAMPLES = 4, 1024
CELLS_PER_RESOLUTION = 4
MOST_CELLS = 512
# Widths are rounded up to one of these steps per decade: the simulator compiles kernels per width.
WIDTHS_PER_DECADE = 6
# Neighbours from which the density of a flood's rays is estimated: within 5 % for grids and for random rays.
NEIGHBOURS = 6
# Rays whose indirect light is below this share of the direct light receive none: no detector has that dynamic range.
FAINTEST_SHARE = 1e-8


def interreflections(scene: Scene, frame: int, rays: Rays, physics: Physics) -> Echoes:
    """Echoes of light reflected by 2 to `MOST_SURFACES` surfaces, in bins of half path.

    Arguments:
        scene: Its bodies' shares of light, and its receiver.
        frame: The time frame.
        rays: All rays of a list.
        physics: The detector, and the key of the simulator's random numbers.

    Raises:
        ConfigError: The simulator is not usable here.
        NumericalError: It died or took too long.
    """
    view = _View.of(scene, frame, rays, physics)
    nothing = view.direct.subset(np.zeros(len(view.direct), dtype=bool))
    if physics.detector.photons is None and resolution_m(physics.detector) == 0:
        return nothing
    is_flood = physics.detector.is_flood
    if not len(view.rays) or ((is_flood or scene.receiver is None) and view.pixel_sr == 0):
        return nothing
    if is_flood:
        # each ray's spot, lit by all other spots
        found, received_sr = view.rendered(view.spots(), bounces=MOST_SURFACES - 1), view.solid_angles()
    elif scene.receiver is None:
        # each ray's pixel, lit by the ray's own spot
        received_sr = np.full(len(view.rays), view.pixel_sr)
        found = view.rendered(view.spots(), bounces=MOST_SURFACES - 1, own_light=True, cone_sr=received_sr)
    else:
        # each ray's spot, lit from the receiver (by reciprocity)
        found = view.rendered(Lights.receiver(scene.receiver), bounces=MOST_SURFACES, direct=False)
        received_sr = np.ones(len(view.rays))
    gain = found.radiance * received_sr[found.ray]
    kept = (np.bincount(found.ray, gain, len(view.rays)) > FAINTEST_SHARE * view.direct.gain)[found.ray]
    ray, cell = found.ray[kept], found.cell[kept]
    path_m = (view.start_m[ray] + view.bins.centres_m[cell]) / 2
    return Echoes(view.number[ray], path_m, gain[kept], view.hits.body[ray])


@dataclass(frozen=True, eq=False)
class _View:
    """Rays that may receive multipath light: their first hit lies before the end of their gate.

    Arguments:
        number: Indices of the rays in the whole list, shape (K,).
        rays, hits, direct: The rays, their first hits and the direct echoes of these.
        start_m: Whole path length at which each ray's bins start, shape (K,) [m].
        pixel_sr: Solid angle of each ray's pixel [sr].
        samples: Light paths per ray.
        seed: Seed of the simulator.
    """

    scene: Scene
    frame: int
    detector: Detector
    number: np.ndarray
    rays: Rays
    hits: Hits
    direct: Echoes
    start_m: np.ndarray
    bins: PathBins
    pixel_sr: float
    samples: int
    seed: int

    @classmethod
    def of(cls, scene: Scene, frame: int, rays: Rays, physics: Physics) -> _View:
        hits = shared_caster(scene, frame).first_hit(rays.origin_m, rays.direction)
        echoes = direct_echoes(scene, Beams.of(rays), hits)
        windows_m = path_windows(rays, scene.receiver)
        direct = echoes.subset(echoes.path_m < windows_m[echoes.ray, 1])
        number = direct.ray
        apart_m = float(np.linalg.norm(np.ptp(rays.origin_m[number], axis=0))) if len(number) else 0.0
        earliest_m = np.maximum(windows_m[number, 0], direct.path_m - apart_m)
        reach_m = float((windows_m[number, 1] - earliest_m).max(initial=0.0))
        # Bins of whole paths that cover twice a reach of half paths, and half a bin on either side of it
        finest_m = max(
            2 * resolution_m(physics.detector) / CELLS_PER_RESOLUTION, 2 * reach_m / MOST_CELLS, EPSILON_FLOAT32
        )
        width_m = 10 ** (math.ceil(math.log10(finest_m) * WIDTHS_PER_DECADE) / WIDTHS_PER_DECADE)
        count = math.ceil(2 * reach_m / width_m) + 1
        bins = PathBins(width_m, 1 << (count - 1).bit_length())
        # a pixel without a solid angle of its own has that of its beam
        photons, beam_sr = physics.detector.photons, math.pi * (physics.detector.divergence_rad / 2) ** 2
        pixel_sr = beam_sr if photons is None else photons.field_of_view_sr
        return cls(
            scene,
            frame,
            physics.detector,
            number,
            rays.subset(number),
            hits.subset(number),
            direct,
            # the direct path lies in the middle of a bin, not on the edge of one
            2 * earliest_m - bins.width_m / 2,
            bins,
            pixel_sr,
            int(np.clip(PATHS // max(len(number), 1), FEWEST_SAMPLES, MOST_SAMPLES)),
            physics.stream("multipath", scene, frame),
        )

    def solid_angles(self) -> np.ndarray:
        """Solid angle of each flood pixel, at most that of its ray's part of the flood, shape (K,) [sr]."""
        from scipy.spatial import cKDTree

        count = min(NEIGHBOURS, len(self.rays) - 1)
        if count == 0:
            return np.array([self.pixel_sr])
        points = self._points()
        apart_m, _ = cKDTree(points).query(points, k=[count + 1])
        area_m2 = np.pi * apart_m[:, 0] ** 2 / count
        cosine = np.abs(np.einsum("nk,nk->n", self.hits.normal, self.rays.direction))
        return np.minimum(area_m2 * cosine / self.hits.range_m**2, self.pixel_sr)

    def _points(self) -> np.ndarray:
        return self.rays.origin_m + self.hits.range_m[:, None] * self.rays.direction

    def spots(self) -> Lights:
        """The spots of all rays as lights."""
        reflectance = reflectances(self.scene, self.hits)
        half_angle_rad = max(self.detector.divergence_rad / 2, math.sqrt(self.pixel_sr / math.pi))
        return Lights.beams(self.hits, self.rays, reflectance, half_angle_rad * self.hits.range_m)

    def rendered(self, lights: Lights, **options: object) -> Transients:
        """Radiance along the rays' looks from these lights."""
        return render_transient(
            self.scene,
            self.frame,
            self._looks(),
            lights,
            replace(self.bins, start_m=self.start_m),
            samples=self.samples,
            seed=self.seed,
            **options,
        )

    def _looks(self) -> Rays:
        """Rays along which indirect light is rendered: from the receiver of a flood, otherwise the beams themselves."""
        receiver = self.scene.receiver
        if receiver is None or not self.detector.is_flood:
            return self.rays
        away = self._points() - np.asarray(receiver.origin_m)
        origin_m = np.tile(np.asarray(receiver.origin_m, dtype=float), (len(away), 1))
        direction = away / np.linalg.norm(away, axis=1, keepdims=True)
        return Rays(origin_m, direction, self.rays.gate_m, self.rays.sensor, self.rays.time_s)


# Rays whose shift by other spots is bounded together.
AT_ONCE = 8


def moved_by_spots_m(first_hits: FirstHits) -> np.ndarray:
    """Range shift by light from other spots of the same list, for a sample of rays of each list, shape (K,) [m]."""
    found = [np.zeros(1)]
    for row in np.unique(first_hits.row[first_hits.returned]):
        rays = np.flatnonzero((first_hits.row == row) & (first_hits.hits.body >= 0))
        own = np.flatnonzero((first_hits.row == row) & first_hits.returned)
        own = own[np.unique(np.linspace(0, len(own) - 1, MOST_POINTS).astype(int))]
        # a few at a time, so that memory stays small beside long lists
        found += [_moved_m(first_hits, some, rays) for some in np.array_split(own, max(len(own) // AT_ONCE, 1))]
    return np.concatenate(found)


def _moved_m(first_hits: FirstHits, own: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Range shift of rays `own` by light from the spots of `rays`, all of one list, shape (len(own),) [m]."""
    place = first_hits.rays.origin_m + first_hits.range_m[:, None] * first_hits.rays.direction
    reflectance = np.array([body.reflectance for body in first_hits.scene.bodies])[first_hits.hits.body[rays]]
    photons, half_rad = first_hits.detector.photons, first_hits.detector.divergence_rad / 2
    pixel_sr = max(photons.field_of_view_sr, math.pi * half_rad**2)
    area_m2 = (pixel_sr * first_hits.range_m**2 / first_hits.cosine)[own, None]
    between = place[rays] - place[own, None]
    apart_m = np.linalg.norm(between, axis=2)
    leaving = np.maximum(np.einsum("ikx,ix->ik", between, first_hits.hits.normal[own]), 0.0)
    facing = np.maximum(-np.einsum("ikx,kx->ik", between, first_hits.hits.normal[rays]), 0.0)
    share = reflectance * np.minimum(safe_divide(leaving * facing * area_m2, math.pi * apart_m**4), 1.0)
    late_m = np.abs(first_hits.range_m[rays] + apart_m - first_hits.range_m[own, None]) / 2
    near = late_m < first_hits.resolution_m
    whitest = min(max(body.reflectance for body in first_hits.scene.bodies), WHITEST)
    return np.minimum((share * late_m * near).sum(axis=1) / (1 - whitest), first_hits.resolution_m)


# A hit nearer than the surface by less than this share is the surface itself: rays are traced to float32.
CLEARANCE_SHARE = 1e-4
# Smallest share of late light that is reported [%].
TINY_PERCENT = 0.01


def why_absent(detector: Detector, scene: Scene, lists: Sequence[Rays]) -> str | None:
    """Reason why multipath light changes nothing, or None."""
    if not detector.bin_s and not detector.pulse_sigma_s:
        return "later light is separate from the first echo"
    return None if any(body.reflectance > 0 for body in scene.bodies) else "nothing reflects"


def bound(first_hits: FirstHits, counts: Counts) -> EffectBound:
    """Bound of the effect of multipath light, the same for all rays: its rms over a sample of points."""
    rows = np.flatnonzero(first_hits.returned)
    if not len(rows):
        return EffectBound(np.zeros(len(first_hits)), np.zeros(len(first_hits)), "no ray returns")
    found = _detours(first_hits, rows)
    squared_m2 = np.mean(np.minimum(found.shift_m, first_hits.width_m[rows][found.chosen]) ** 2)
    spots_shine = first_hits.detector.is_flood and first_hits.scene.receiver is None
    by_spots_m2 = np.mean(moved_by_spots_m(first_hits) ** 2) if spots_shine else 0.0
    alone = _hidden(first_hits, rows[found.chosen]) & (found.seen > 0)
    outweighed = np.mean((found.apart > 1) | alone)
    late = 100 * found.share.mean()
    reason = (
        f"other surfaces fill {100 * found.seen.mean():.2g} % of what a surface sees; "
        + (f"late light is at most {late:.2g} %" if late >= TINY_PERCENT else f"late light is below {TINY_PERCENT} %")
        + (f", and the only light of {100 * alone.mean():.3g} % of returns" if alone.any() else "")
    )
    if by_spots_m2 > squared_m2:
        reason = f"the spots of a flood light each other, {reason}"
    squared = np.full(len(first_hits), max(squared_m2, by_spots_m2))
    return EffectBound(squared, np.where(first_hits.returned, outweighed, 0.0), reason)


def _hidden(first_hits: FirstHits, rows: np.ndarray) -> np.ndarray:
    """Mask of hits that a bistatic receiver does not see directly, shape (K,)."""
    receiver = first_hits.scene.receiver
    if receiver is None:
        return np.zeros(len(rows), dtype=bool)
    home, origin_m = np.asarray(receiver.origin_m), first_hits.rays.origin_m[rows]
    points = origin_m + first_hits.range_m[rows, None] * first_hits.rays.direction[rows]
    way, hidden = points - home, ~in_view(receiver, points)
    length_m = np.linalg.norm(way, axis=1)
    asked = ~hidden & (origin_m != home).any(axis=1) & (length_m > 0)
    met_m = first_hits.caster.first_hit(np.broadcast_to(home, way[asked].shape), way[asked]).range_m
    hidden[asked] = met_m < length_m[asked] * (1 - CLEARANCE_SHARE)
    return hidden


def _detours(first_hits: FirstHits, rows: np.ndarray) -> Detours:
    rays, hits = first_hits.rays.subset(rows), first_hits.hits.subset(rows)
    photons, receiver = first_hits.detector.photons, first_hits.scene.receiver
    flood = first_hits.detector.is_flood
    if not flood and receiver is None:
        beam_sr = math.pi * (first_hits.detector.divergence_rad / 2) ** 2
        pixel_sr = beam_sr if photons is None else max(photons.field_of_view_sr, beam_sr)
        return pixel_bound(first_hits.scene, rays, hits, first_hits.caster, pixel_sr, first_hits.resolution_m)
    # a flood's pixels see spots lit by its emitters; a fixed receiver gets light from anywhere in its view
    lamp_m = None if flood or receiver is None else np.asarray(receiver.origin_m)
    return lamp_bound(first_hits.scene, rays, hits, first_hits.caster, lamp_m, first_hits.resolution_m)
