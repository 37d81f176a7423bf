"""Histograms of counted photons: what arrives, by effect, and what of it is counted.

The photon histograms that a detector would hand out, one per ray: what captures consist of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidardesign.errors import ConfigError
from lidardesign.geometry.raycast import SceneCaster
from lidardesign.geometry.rays import Rays
from lidardesign.scene import Scene
from lidardesign.simulate.detector.arrival_kernels import (
    add_bins,
    add_even_light,
    add_photons,
    echo_of,
    even_counts,
    expected_in_bins,
)
from lidardesign.simulate.detector.detection import chunks
from lidardesign.simulate.detector.detector import metres
from lidardesign.simulate.detector.histogram import Bins, bins_of, check_windows
from lidardesign.simulate.detector.light import Background, Echoes
from lidardesign.simulate.physics import Physics, followed_light
from lidardesign.simulate.streams import MOST_COUNTS, normal_quantiles

# Rays that more photons than this are expected of are counted bin by bin, others photon by photon
PHOTONS_ONE_BY_ONE = 512.0


@dataclass(frozen=True, eq=False)
class Light:
    """The light that N neighbouring rays of a list get in a frame, E echoes.

    Arguments:
        bins: What it is sorted into.
        first_ray: Index of the first of them in the list.
        rays: How many rays the list has, which share the emitter's energy.
        pulses: How many pulses each of them gets.
        echo_offset: Echoes of ray i are echo_offset[i] to echo_offset[i + 1], shape (N + 1,).
        path_m: Their half paths, shape (E,) [m].
        expected: Their expected counts in a frame, shape (E,).
        per_metre: Ambient and dark counts per pulse and metre, shape (N,).
        edges_m, haze: Cells of haze, (N, C + 1) [m], and their counts per pulse, (N, C); None: clear air.
    """

    bins: Bins
    first_ray: int
    rays: int
    pulses: float
    echo_offset: np.ndarray
    path_m: np.ndarray
    expected: np.ndarray
    per_metre: np.ndarray
    edges_m: np.ndarray | None = None
    haze: np.ndarray | None = None

    @classmethod
    def of(cls, windows_m: np.ndarray, echoes: Echoes, background: Background, physics: Physics) -> Light:
        """All the light of a list of rays with windows (N, 2) [m].

        Raises:
            ConfigError: A window has too many bins.
        """
        count, photons = len(windows_m), physics.detector.photons
        bins = bins_of(windows_m, echoes, physics.detector, "quantisation" in physics.effects)
        order = np.argsort(echoes.ray, kind="stable")
        offset = np.concatenate([[0], np.cumsum(np.bincount(echoes.ray, minlength=count))])
        pulses = photons.pulses(count)
        per_gain = pulses * photons.emitted(count) * photons.aperture_m2 * photons.efficiency
        # limited before the product: a surface that touches the receiver has the largest gain there is
        expected = np.minimum(echoes.gain[order], MOST_COUNTS / per_gain) * per_gain
        return cls(
            bins,
            0,
            count,
            pulses,
            offset,
            echoes.path_m[order],
            expected,
            background.per_metre,
            background.edges_m,
            background.counts,
        )

    def part(self, begin: int, end: int) -> Light:
        """That of rays begin to end."""
        echoes = slice(self.echo_offset[begin], self.echo_offset[end])
        return Light(
            self.bins.part(begin, end),
            self.first_ray + begin,
            self.rays,
            self.pulses,
            self.echo_offset[begin : end + 1] - self.echo_offset[begin],
            self.path_m[echoes],
            self.expected[echoes],
            self.per_metre[begin:end],
            None if self.edges_m is None else self.edges_m[begin:end],
            None if self.haze is None else self.haze[begin:end],
        )


def histogram(scene: Scene, frame: int, light: Light, physics: Physics) -> np.ndarray:
    """Counts per bin of the rays that `light` is of, flat as its bins say."""
    counts = np.zeros(light.bins.offset[-1], np.int64)
    _add_echoes(counts, scene, frame, light, physics)
    if "ambient" in physics.effects:
        total = light.pulses * light.per_metre * np.diff(light.bins.windows_m, axis=1)[:, 0]
        _add_even(counts, light, light.bins.windows_m, total[:, None], physics.stream("ambient", scene, frame))
    if light.haze is not None:
        key = physics.stream("atmosphere", scene, frame)
        _add_even(counts, light, light.edges_m, light.pulses * light.haze, key)
    if "pile_up" in physics.effects:
        from lidardesign.simulate.effects.pile_up import counted

        key = physics.stream("pile_up", scene, frame)
        counts = counted(counts, light.bins, physics.detector.photons, light.rays, key, light.first_ray)
    return counts


def _add_even(counts: np.ndarray, light: Light, edges_m: np.ndarray, expected: np.ndarray, key: int) -> None:
    bins = light.bins
    add_even_light(
        counts,
        bins.offset,
        bins.first_m,
        bins.width_m,
        bins.windows_m,
        np.ascontiguousarray(edges_m),
        np.minimum(expected, MOST_COUNTS),
        np.uint64(key),
        light.first_ray,
    )


def _add_echoes(counts: np.ndarray, scene: Scene, frame: int, light: Light, physics: Physics) -> None:
    """Photons of echoes: one by one in rays with few of them, bin by bin in others."""
    # ray by ray: in differences of running sums a blinding echo would drown those of other rays
    ray = np.repeat(np.arange(len(light.bins)), np.diff(light.echo_offset))
    total = np.bincount(ray, weights=light.expected, minlength=len(light.bins))
    few = np.flatnonzero((total <= PHOTONS_ONE_BY_ONE) & (total > 0))
    many = np.flatnonzero(total > PHOTONS_ONE_BY_ONE)
    if len(few):
        _add_one_by_one(counts, scene, frame, light, few, total[few], physics)
    if len(many):
        _add_bin_by_bin(counts, scene, frame, light, many, physics)


def _add_one_by_one(
    counts: np.ndarray,
    scene: Scene,
    frame: int,
    light: Light,
    few: np.ndarray,
    total: np.ndarray,
    physics: Physics,
) -> None:
    detector, effects, bins = physics.detector, physics.effects, light.bins
    noisy = "photon_noise" in effects
    if noisy:
        from lidardesign.simulate.effects import photon_noise

        key = physics.stream("photon_noise", scene, frame)
        number = photon_noise.numbers(total, light.first_ray + few, key)
    else:
        number = np.floor(total + 0.5).astype(np.int64)
    ray = np.repeat(few, number)
    order = np.arange(len(ray)) - np.repeat(np.cumsum(number) - number, number)
    if noisy:
        share, stray = photon_noise.places(light.first_ray + ray, order, key)
        echo, _ = echo_of(ray, share, light.echo_offset, light.expected)
    else:
        echo, rest = echo_of(ray, (order + 0.5) / np.repeat(number, number), light.echo_offset, light.expected)
        stray = normal_quantiles(rest)
    path_m = light.path_m[echo] + metres(detector.pulse_sigma_s) * stray
    if "jitter" in effects:
        from lidardesign.simulate.effects.jitter import displaced

        path_m = displaced(path_m, light.first_ray + ray, order, detector, physics.stream("jitter", scene, frame))
    add_photons(counts, bins.offset, bins.first_m, bins.width_m, bins.windows_m, ray, path_m)


def _add_bin_by_bin(
    counts: np.ndarray, scene: Scene, frame: int, light: Light, many: np.ndarray, physics: Physics
) -> None:
    detector, effects, bins = physics.detector, physics.effects, light.bins
    sigma_m = metres(detector.timing_sigma_s if "jitter" in effects else detector.pulse_sigma_s)
    expected = expected_in_bins(
        many,
        bins.offset,
        bins.first_m,
        bins.width_m,
        bins.windows_m,
        light.echo_offset,
        light.path_m,
        light.expected,
        sigma_m,
    )
    offset = np.concatenate([[0], np.cumsum(np.diff(bins.offset)[many])])
    if "photon_noise" in effects:
        from lidardesign.simulate.effects.photon_noise import of_bins

        found = of_bins(expected, offset, light.first_ray + many, physics.stream("photon_noise", scene, frame))
    elif "jitter" in effects:
        from lidardesign.simulate.effects.jitter import of_bins

        found = of_bins(expected, offset, light.first_ray + many, physics.stream("jitter", scene, frame))
    else:
        found = even_counts(expected, offset)
    add_bins(counts, bins.offset, many, found)


@dataclass(frozen=True, eq=False)
class PhotonHistograms:
    """Counts over time of N rays.

    Arguments:
        start_m: Where each ray's first bin starts, as half the whole path, shape (N,) [m]. The first and the last bin
            hold only what lies within the ray's gate.
        width_m: Of a bin, in half paths [m].
        number: How many bins each ray has, shape (N,).
        counts: Photons counted per bin, zero beyond a ray's own bins, shape (N, most bins).
        pulses: How many pulses each ray got.
    """

    start_m: np.ndarray
    width_m: float
    number: np.ndarray
    counts: np.ndarray
    pulses: float


def photon_histograms(
    scene: Scene, frame: int, rays: Rays, caster: SceneCaster, physics: Physics
) -> PhotonHistograms:
    """The histograms that `simulate` finds the returns of rays in, with the same random numbers.

    Arguments:
        scene: What the rays meet.
        frame: The time frame.
        rays: The rays that share the emitter's energy, N of them.
        caster: Of this frame.
        physics: A detector that counts photons, and the effects that are on.

    Raises:
        ConfigError: The detector counts no photons, or its histogram does not cover a gate.
    """
    detector = physics.detector
    if detector.photons is None:
        raise ConfigError(
            f"the detector {detector.name!r} counts no photons",
            where="--detector",
            allowed="one with a light budget, as single-photon",
        )
    light = followed_light(scene, frame, rays, caster, physics)
    check_windows(light.windows_m, detector)
    whole = Light.of(light.windows_m, light.echoes, light.background, physics)
    number = np.diff(whole.bins.offset)
    counts = np.zeros((len(rays), number.max(initial=0)), np.int64)
    for begin, end in chunks(whole.bins):
        filled = np.arange(counts.shape[1]) < number[begin:end, None]
        counts[begin:end][filled] = histogram(scene, frame, whole.part(begin, end), physics)
    return PhotonHistograms(whole.bins.first_m, whole.bins.width_m, number, counts, whole.pulses)


def coates(counts: np.ndarray, pulses: float) -> np.ndarray:
    """Photons per pulse that arrived in each bin, from those that a detector counted which is blind after the first.

    A bin's photons can only be counted in pulses that were not over: log((P - C_before) / (P - C_to_here)), with C the
    running count (Coates 1968). In bins after the last pulse was used up nothing is known: NaN.

    Arguments:
        counts: Photons counted per bin, from the time on at which the detector was armed, shape (..., B).
        pulses: How many pulses there were.

    Raises:
        ConfigError: More photons were counted than there were pulses.
    """
    counts = np.asarray(counts, dtype=np.float64)
    used = np.cumsum(counts, axis=-1)
    if (used[..., -1:] > pulses).any() or (counts < 0).any():
        raise ConfigError(
            f"{used[..., -1:].max():g} photons in {pulses:g} pulses",
            where="Coates' correction",
            allowed="at most one photon per pulse, and no negative counts",
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        arrived = np.log((pulses - used + counts) / (pulses - used))
    return np.where(pulses - used > 0, arrived, np.nan)
