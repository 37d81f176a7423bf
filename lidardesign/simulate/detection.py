"""Detection: the strongest echo, or the return in a histogram of counted photons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Scene
from lidardesign.simulate.detector.dead_time import find_corrected
from lidardesign.simulate.detector.kernels import (
    add_bins,
    add_even_light,
    add_photons,
    echo_of,
    even_counts,
    expected_in_bins,
    find_returns,
    poisson_of_bins,
)
from lidardesign.simulate.detector.light import Background, Echoes
from lidardesign.simulate.detector.physics import (
    COUNTED,
    FWHM_PER_SIGMA,
    MOST_COUNTS,
    Bins,
    Physics,
    bins_of,
    check_windows,
    chunks,
    metres,
    resolution_m,
)
from lidardesign.simulate.detector.streams import normal_quantiles
from lidardesign.simulate.effects.jitter import add_timing_errors
from lidardesign.simulate.effects.photon_noise import draw_numbers, draw_places
from lidardesign.simulate.effects.pile_up import survive_dead_time
from lidardesign.simulate.effects.quantisation import round_to_bins

# Rays with more expected photons than this are counted bin by bin, others photon by photon
PHOTONS_ONE_BY_ONE = 512.0
# Draws of a ray whose bins are counted one by one, beyond those of its photons
FIRST_BIN = 1 << 40
# A range further than this many standard deviations (and half a bin) from every echo is a false alarm
EXPLAINED_SIGMAS = 3.0


def detect(
    scene: Scene,
    frame: int,
    rays: Rays,
    windows_m: np.ndarray,
    echoes: Echoes,
    background: Background,
    physics: Physics,
) -> tuple[np.ndarray, np.ndarray]:
    """Detect the returns of all rays of a frame; those of a sensor share its emitter's light.

    Returns:
        Half the whole path, NaN without a return, and the index of the echo's body, -1 for false alarms and without a
        return; shapes (N,) [m] and (N,).

    Arguments:
        scene, frame: They name the random streams.
        rays: The rays, N of them.
        windows_m: Each ray's gate in half paths, closed at the start and open at the end, shape (N, 2) [m].
        echoes: The light that comes back.
        background: Counts from ambient light, dark counts and haze.
        physics: The detector and the effects that are on.

    Raises:
        ConfigError: A window that the detector's histogram does not cover.
    """
    check_windows(windows_m, physics.detector)
    if physics.detector.photons is None or not physics.effects & COUNTED:
        return _strongest(scene, frame, windows_m, echoes, physics)
    path_m = np.full(len(windows_m), np.nan)
    light = ArrivingLight.of(rays, windows_m, echoes, background, physics)
    for begin, end in chunks(light.bins.offset):
        path_m[begin:end] = _from_photons(scene, frame, light.part(begin, end), physics)
    # The body of the strongest echo near each detected half path, -1 where there is none
    tolerance = EXPLAINED_SIGMAS * metres(physics.detector.timing_sigma_s) + light.bins.width_m / 2
    with np.errstate(invalid="ignore"):
        near = np.flatnonzero((np.abs(echoes.path_m - path_m[echoes.ray]) <= tolerance) & (echoes.gain > 0))
    rising = near[np.argsort(echoes.gain[near], kind="stable")]
    body = np.full(len(windows_m), -1)
    body[echoes.ray[rising]] = echoes.body[rising]
    return path_m, body


def _from_photons(scene: Scene, frame: int, light: ArrivingLight, physics: Physics) -> np.ndarray:
    """Half paths of the returns in a chunk's histograms, NaN without a return, shape (N,) [m]."""
    detector, bins = physics.detector, light.bins
    counts = count_photons(scene, frame, light, physics)
    sigma_m = metres(detector.timing_sigma_s)
    half = int(FWHM_PER_SIGMA * sigma_m / (2 * bins.width_m))
    judged = (
        counts,
        bins.offset,
        bins.end_shares,
        bins.width_m,
        sigma_m,
        half,
        _known_level(light, physics),
        detector.false_alarm,
        detector.estimator == "matched",
    )
    if detector.correction == "coates" and detector.photons.dead_s > 0:
        # it judges in the same way, and finds nothing to correct, where it is never blind
        dead_s = detector.photons.dead_s if "pile_up" in physics.effects else 0.0
        times_m = metres(dead_s), metres(1 / detector.photons.repetition_hz)
        place = find_corrected(*judged, np.maximum(light.pulses, 1.0), *(time_m / bins.width_m for time_m in times_m))
    else:
        place = find_returns(*judged)
    low, high = bins.windows_m[:, 0], bins.windows_m[:, 1]
    return np.clip(bins.first_m + place * bins.width_m, low, np.nextafter(high, low))


def _known_level(light: ArrivingLight, physics: Physics) -> np.ndarray:
    """Background counts per bin that a detector measures between its pulses, thinned by dead time, shape (N,).

    With a correction, they are those of pulses that are all alive; at most one per pulse and bin.
    """
    detector, width_m = physics.detector, light.bins.width_m
    arriving = light.per_metre * width_m
    if detector.correction == "coates" and detector.photons.dead_s > 0:
        return light.pulses * -np.expm1(-arriving)
    if "pile_up" not in physics.effects:
        return light.pulses * arriving
    return light.pulses * arriving / (1 + light.per_metre * metres(detector.photons.dead_s))


def _strongest(
    scene: Scene, frame: int, windows_m: np.ndarray, echoes: Echoes, physics: Physics
) -> tuple[np.ndarray, np.ndarray]:
    """The strongest echo in each window, averaged by gain with the echoes within the detector's resolution."""
    count, detector = len(windows_m), physics.detector
    inside = (echoes.path_m >= windows_m[echoes.ray, 0]) & (echoes.path_m < windows_m[echoes.ray, 1])
    echoes = echoes.subset(inside & (echoes.gain > 0))
    rising = np.argsort(echoes.gain, kind="stable")
    best = np.full(count, -1)
    best[echoes.ray[rising]] = rising
    found = best >= 0
    path_m, body = np.full(count, np.nan), np.full(count, -1)
    path_m[found], body[found] = echoes.path_m[best[found]], echoes.body[best[found]]
    # Shift of each ray's range by echoes near the strongest one (index `best`, -1: none) [m]
    resolution = resolution_m(detector)
    away = echoes.path_m - path_m[echoes.ray]
    near = np.abs(away) <= resolution
    ray = echoes.ray[near]
    weight = echoes.gain[near] / echoes.gain[best[ray]]
    moved = np.bincount(ray, weights=weight * away[near], minlength=len(path_m))
    total = np.bincount(ray, weights=weight, minlength=len(path_m))
    path_m += moved / np.where(total > 0, total, 1.0)
    if "jitter" in physics.effects:
        path_m = add_timing_errors(
            path_m, np.arange(count), np.zeros(count, int), detector, physics.stream("jitter", scene, frame)
        )
        path_m = np.clip(path_m, windows_m[:, 0], np.nextafter(windows_m[:, 1], windows_m[:, 0]))
    if "quantisation" in physics.effects:
        path_m = round_to_bins(path_m, windows_m, detector)
    return path_m, body


@dataclass(frozen=True, eq=False)
class ArrivingLight:
    """The light that N consecutive rays of a list receive in a frame, E echoes.

    Arguments:
        bins: Bins of the histograms.
        first_ray: Index of the first ray in the list.
        pulses: Number of pulses of each ray, shape (N,).
        echo_offset: Echoes of ray i are echo_offset[i] to echo_offset[i + 1], shape (N + 1,).
        path_m: Half paths of the echoes, shape (E,) [m].
        expected: Expected counts of the echoes in a frame, shape (E,).
        per_metre: Ambient and dark counts per pulse and metre, shape (N,).
        edges_m, haze: Cells of haze, (N, C + 1) [m], and their counts per pulse, (N, C); None: clear air.
    """

    bins: Bins
    first_ray: int
    pulses: np.ndarray
    echo_offset: np.ndarray
    path_m: np.ndarray
    expected: np.ndarray
    per_metre: np.ndarray
    edges_m: np.ndarray | None = None
    haze: np.ndarray | None = None

    @classmethod
    def of(
        cls, rays: Rays, windows_m: np.ndarray, echoes: Echoes, background: Background, physics: Physics
    ) -> ArrivingLight:
        """All the light of a list of rays with windows (N, 2) [m].

        Raises:
            ConfigError: A window has too many bins.
        """
        count, photons = len(windows_m), physics.detector.photons
        sharing = physics.detector.sharing(rays)
        bins = bins_of(windows_m, echoes, physics.detector, "quantisation" in physics.effects)
        order = np.argsort(echoes.ray, kind="stable")
        offset = np.concatenate([[0], np.cumsum(np.bincount(echoes.ray, minlength=count))])
        pulses = photons.pulses(sharing)
        per_pulse = photons.emitted(sharing) * physics.detector.light_of(rays)
        per_gain = (pulses * per_pulse * photons.aperture_m2 * photons.efficiency)[echoes.ray[order]]
        # limited before the product: a surface that touches the receiver has the largest gain there is
        expected = np.minimum(echoes.gain[order], MOST_COUNTS / per_gain) * per_gain
        return cls(
            bins,
            0,
            pulses,
            offset,
            echoes.path_m[order],
            expected,
            background.per_metre,
            background.edges_m,
            background.counts,
        )

    def part(self, begin: int, end: int) -> ArrivingLight:
        """The light of rays begin to end."""
        echoes = slice(self.echo_offset[begin], self.echo_offset[end])
        return ArrivingLight(
            self.bins.part(begin, end),
            self.first_ray + begin,
            self.pulses[begin:end],
            self.echo_offset[begin : end + 1] - self.echo_offset[begin],
            self.path_m[echoes],
            self.expected[echoes],
            self.per_metre[begin:end],
            None if self.edges_m is None else self.edges_m[begin:end],
            None if self.haze is None else self.haze[begin:end],
        )


def count_photons(scene: Scene, frame: int, light: ArrivingLight, physics: Physics) -> np.ndarray:
    """Simulated counts per bin of the rays of `light`, flat with the offsets of its bins."""
    counts = np.zeros(light.bins.offset[-1], np.int64)
    # ray by ray: differences of running sums would lose other rays next to a very strong echo
    ray = np.repeat(np.arange(len(light.bins)), np.diff(light.echo_offset))
    total = np.bincount(ray, weights=light.expected, minlength=len(light.bins))
    few = np.flatnonzero((total <= PHOTONS_ONE_BY_ONE) & (total > 0))
    many = np.flatnonzero(total > PHOTONS_ONE_BY_ONE)
    if len(few):
        _add_one_by_one(counts, scene, frame, light, few, total[few], physics)
    if len(many):
        _add_bin_by_bin(counts, scene, frame, light, many, physics)
    if "ambient" in physics.effects:
        total = light.pulses * light.per_metre * np.diff(light.bins.windows_m, axis=1)[:, 0]
        _add_even(counts, light, light.bins.windows_m, total[:, None], physics.stream("ambient", scene, frame))
    if light.haze is not None:
        haze = light.pulses[:, None] * light.haze
        _add_even(counts, light, light.edges_m, haze, physics.stream("atmosphere", scene, frame))
    if "pile_up" in physics.effects:
        key = physics.stream("pile_up", scene, frame)
        counts = survive_dead_time(counts, light.bins, physics.detector.photons, light.pulses, key, light.first_ray)
    return counts


def _add_even(counts: np.ndarray, light: ArrivingLight, edges_m: np.ndarray, expected: np.ndarray, key: int) -> None:
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


def _add_one_by_one(
    counts: np.ndarray,
    scene: Scene,
    frame: int,
    light: ArrivingLight,
    few: np.ndarray,
    total: np.ndarray,
    physics: Physics,
) -> None:
    detector, effects, bins = physics.detector, physics.effects, light.bins
    noisy = "photon_noise" in effects
    if noisy:
        key = physics.stream("photon_noise", scene, frame)
        number = draw_numbers(total, light.first_ray + few, key)
    else:
        number = np.floor(total + 0.5).astype(np.int64)
    ray = np.repeat(few, number)
    order = np.arange(len(ray)) - np.repeat(np.cumsum(number) - number, number)
    if noisy:
        share, stray = draw_places(light.first_ray + ray, order, key)
        echo, _ = echo_of(ray, share, light.echo_offset, light.expected)
    else:
        echo, rest = echo_of(ray, (order + 0.5) / np.repeat(number, number), light.echo_offset, light.expected)
        stray = normal_quantiles(rest)
    path_m = light.path_m[echo] + metres(detector.pulse_sigma_s) * stray
    if "jitter" in effects:
        path_m = add_timing_errors(
            path_m, light.first_ray + ray, order, detector, physics.stream("jitter", scene, frame)
        )
    add_photons(counts, bins.offset, bins.first_m, bins.width_m, bins.windows_m, ray, path_m)


def _add_bin_by_bin(
    counts: np.ndarray, scene: Scene, frame: int, light: ArrivingLight, many: np.ndarray, physics: Physics
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
    # with photon noise or jitter counts of bins are Poisson, drawn from the first one's stream
    chance = [name for name in ("photon_noise", "jitter") if name in effects]
    if chance:
        key = np.uint64(physics.stream(chance[0], scene, frame))
        found = poisson_of_bins(expected, offset, light.first_ray + many, key, FIRST_BIN)
    else:
        found = even_counts(expected, offset)
    add_bins(counts, bins.offset, many, found)
