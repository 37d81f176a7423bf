"""Light that comes back by way of other surfaces, rendered by the light-transport simulator.

Which detours a receiver hears depends on what is lit and what is looked at while a ray is listened to:

- A *flood* lights all rays' spots at once, and each pixel sees its own: light goes from the emitter to Q, to P and
  back, and pixel n sees its spot P, which all other spots Q light too. The spots are the lights, matt points with the
  power of what they reflect (Keller 1997, Instant radiosity), so that light goes where the design's rays go and nowhere
  else. Where pixels overlap, each hears the part that is its own ray's, of detours as of direct light.
- A *scanned* beam lights one spot P, and its pixel sees a cone around the beam: light comes back by P, Q, P and, where
  Q lies in that cone, by P, Q. The beam's own spot is the only light, looked at along rays spread in the cone. A pixel
  without a solid angle hears no detours.
- A *fixed receiver* hears a scanned beam's detours P, Q from all Q that lie in its field of view. By reciprocity light
  is sent from the receiver instead, and what is seen along the beam is its gain.

A detector that resolves everything and counts nothing (`ideal`) takes no late light for an echo, not even where no
direct one arrives.

Paths have up to `MOST_SURFACES` surfaces. A spot has a size, within which its light grows no stronger: without it, the
few paths that end next to a spot in a crease would be worth any amount; light within a spot's own size is not told from
its direct echo. Beams are thin, and nothing moves within a frame. Mirrors and glass are left to `specular`: here they
swallow what they do not scatter, so that no light is heard twice. What arrives earlier than a ray's direct echo by more
than the emitters are apart (from nearer surfaces at the edge of its pixel) is left out. Estimates are unbiased up to
that; their noise falls with the root of `PATHS`, which all rays share.

Echoes are the simulator's bins of half path, a quarter of the detector's resolution where no more than `MOST_CELLS` of
them reach to the gates' ends. They name the body of the ray's first hit, whose echo they disturb.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidardesign.numerics import EPSILON_FLOAT32
from lidardesign.scene import Scene
from lidardesign.simulate.bistatic import path_windows
from lidardesign.simulate.detector import Detector
from lidardesign.simulate.echoes import Beams, Echoes
from lidardesign.simulate.histogram import resolution_m
from lidardesign.simulate.hits import Hits
from lidardesign.simulate.light_transport import Lights, PathBins, Transients, render_transient
from lidardesign.simulate.physics import Physics, direct_echoes
from lidardesign.simulate.raycast import shared_caster
from lidardesign.simulate.returns import Rays

MOST_SURFACES = 6
# Light paths of a frame, all rays together: about a second.
PATHS = 1 << 19
FEWEST_SAMPLES, MOST_SAMPLES = 4, 1024
CELLS_PER_RESOLUTION = 4
MOST_CELLS = 512
# Widths are rounded up to one of these steps per decade: the simulator compiles kernels per width.
WIDTHS_PER_DECADE = 6
# How densely a flood's rays lie is told from so many neighbours: right for grids and for random ones, within 5 %.
NEIGHBOURS = 6
# Rays whose detours together are fainter than this share of the direct light hear none: no detector counts so far.
FAINTEST_SHARE = 1e-8


def interreflections(scene: Scene, frame: int, rays: Rays, physics: Physics) -> Echoes:
    """Echoes of light that met 2 to `MOST_SURFACES` surfaces, in cells of half path.

    Arguments:
        scene: Its bodies' shares of light, and its receiver.
        frame: The time frame.
        rays: The rays that share the emitter's energy.
        physics: The detector, and the key of the simulator's random numbers.

    Raises:
        ConfigError: The simulator is not usable here.
        NumericalError: It died or took too long.
    """
    view = _View.of(scene, frame, rays, physics)
    nothing = view.direct.kept(np.zeros(len(view.direct), dtype=bool))
    if physics.detector.photons is None and resolution_m(physics.detector) == 0:
        return nothing
    flood = physics.detector.photons is not None and physics.detector.photons.emission == "flood"
    by_pixel = flood or scene.receiver is None
    if not len(view.rays) or (by_pixel and view.pixel_sr == 0):
        return nothing
    found = view.of_a_flood() if flood else view.of_a_pixel() if by_pixel else view.of_a_receiver()
    heard_sr = view.solid_angles() if flood else np.full(len(view.rays), view.pixel_sr if by_pixel else 1.0)
    gain = found.radiance * heard_sr[found.ray]
    together = np.bincount(found.ray, gain, len(view.rays))
    kept = (together > FAINTEST_SHARE * view.direct.gain)[found.ray]
    ray, cell = found.ray[kept], found.cell[kept]
    path_m = (view.start_m[ray] + found.bins.centres_m[cell]) / 2
    return Echoes(view.number[ray], path_m, gain[kept], view.hits.body[ray])


@dataclass(frozen=True, eq=False)
class _View:
    """Rays that could hear detours: their first hit lies before the end of their gate.

    Arguments:
        number: Their places in the whole list, shape (K,).
        rays, hits, direct: They, what they meet and its echo.
        start_m: Whole paths that their bins start at, shape (K,).
        pixel_sr: Solid angle that each one's pixel sees.
        samples: Light paths for each.
        seed: Of the simulator.
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
        in_time = echoes.path_m < windows_m[echoes.ray, 1]
        direct = echoes.kept(in_time)
        number = direct.ray
        apart_m = float(np.linalg.norm(np.ptp(rays.origin_m[number], axis=0))) if len(number) else 0.0
        earliest_m = np.maximum(windows_m[number, 0], direct.path_m - apart_m)
        reach_m = float((windows_m[number, 1] - earliest_m).max(initial=0.0))
        bins = _bins(physics.detector, reach_m)
        return cls(
            scene,
            frame,
            physics.detector,
            number,
            rays.subset(number),
            Hits(hits.range_m[number], hits.body[number], hits.normal[number]),
            direct,
            # the direct path lies in the middle of a bin, not on the edge of one
            2 * earliest_m - bins.width_m / 2,
            bins,
            _pixel_sr(physics.detector),
            int(np.clip(PATHS // max(len(number), 1), FEWEST_SAMPLES, MOST_SAMPLES)),
            physics.stream("multipath", scene, frame),
        )

    def of_a_flood(self) -> Transients:
        """Radiance of spots that all other spots light."""
        return self._rendered(self._spots(), bounces=MOST_SURFACES - 1)

    def of_a_pixel(self) -> Transients:
        """Radiance of what lies in each ray's pixel, lit by its own spot."""
        cone_sr = np.full(len(self.rays), self.pixel_sr)
        return self._rendered(self._spots(), bounces=MOST_SURFACES - 1, own_light=True, cone_sr=cone_sr)

    def of_a_receiver(self) -> Transients:
        """Radiance of spots in the light of the receiver, less what comes from there directly."""
        lights = Lights.receiver(self.scene.receiver)
        return self._rendered(lights, bounces=MOST_SURFACES, direct=False)

    def solid_angles(self) -> np.ndarray:
        """The solid angle that each pixel of a flood sees, or that its ray's part of the flood fills if less, (K,)."""
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

    def _spots(self) -> Lights:
        reflectance = np.array([body.reflectance for body in self.scene.bodies])[self.hits.body]
        half_angle_rad = max(self.detector.divergence_rad / 2, math.sqrt(self.pixel_sr / math.pi))
        return Lights.beams(self.hits, self.rays, reflectance, radius_m=half_angle_rad * self.hits.range_m)

    def _rendered(self, lights: Lights, **options: object) -> Transients:
        return render_transient(
            self.scene,
            self.frame,
            self._looks(),
            lights,
            self.bins,
            matt=True,
            samples=self.samples,
            seed=self.seed,
            baseline_m=self.start_m,
            **options,
        )

    def _looks(self) -> Rays:
        """The lines along which detours are looked for: from where light is heard, or along the beams themselves."""
        photons = self.detector.photons
        receiver = self.scene.receiver
        if receiver is None or photons is None or photons.emission != "flood":
            return self.rays
        away = self._points() - np.asarray(receiver.origin_m)
        origin_m = np.tile(np.asarray(receiver.origin_m, dtype=float), (len(away), 1))
        direction = away / np.linalg.norm(away, axis=1, keepdims=True)
        return Rays(origin_m, direction, self.rays.gate_m, self.rays.sensor, self.rays.time_s)


def _pixel_sr(detector: Detector) -> float:
    """The solid angle of a ray's pixel; without one of its own, that of its beam [sr]."""
    if detector.photons is not None:
        return detector.photons.field_of_view_sr
    return math.pi * (detector.divergence_rad / 2) ** 2


def _bins(detector: Detector, reach_m: float) -> PathBins:
    """Bins of whole paths that cover twice a reach of half paths, and half a bin on either side of it."""
    told_apart_m = 2 * resolution_m(detector) / CELLS_PER_RESOLUTION
    finest_m = max(told_apart_m, 2 * reach_m / MOST_CELLS, EPSILON_FLOAT32)
    width_m = 10 ** (math.ceil(math.log10(finest_m) * WIDTHS_PER_DECADE) / WIDTHS_PER_DECADE)
    count = math.ceil(2 * reach_m / width_m) + 1
    return PathBins(width_m, 1 << (count - 1).bit_length())
