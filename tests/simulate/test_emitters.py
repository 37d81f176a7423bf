"""An emitter per sensor: laws of sharing, of one emitter for all, and of the devices of baselines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.rays import random_fan, rays_along
from support.scoring import entries_of, make_request
from support.sensors import normal_sensor
from support.synthetic_light import PHOTON_EFFECTS

from lidardesign.scenes.rays import Rays
from lidardesign.scenes.scene import Ambient, Body, Medium, Scene, Sphere
from lidardesign.scoring.fired import ONE_DEVICE, Devices, assign_devices
from lidardesign.sensors.design import DesignSpec
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import Physics
from lidardesign.simulate.effects.expected_counts import Counts
from lidardesign.simulate.effects.first_hits import FirstHits
from lidardesign.simulate.plan import Planner
from lidardesign.simulate.returns import build_casters, photon_histograms, simulate

ALL = frozenset({*PHOTON_EFFECTS, "atmosphere"})
ROOM = Scene((Body(Sphere(1.5), reflectance=0.02),), ambient=Ambient(3000.0), medium=Medium(0.05, 0.005))
DETECTORS = {name: load_detector(name) for name in ("single-photon", "consumer-8x8")}
both = pytest.mark.parametrize("detector", DETECTORS.values(), ids=DETECTORS)


def fan(count=40, seed=0):
    return rays_along(random_fan(count, 0.6, seed), (0.1, 2.0))


def of_sensors(rays, sensor):
    return replace(rays, sensor=np.asarray(sensor))


def two_sensors(count=40):
    return of_sensors(Rays.joined([fan(count), fan(count, 1)]), np.repeat([0, 1], count))


def histograms(rays, detector, effects=ALL):
    return photon_histograms(ROOM, 0, rays, build_casters(ROOM)[0], Physics(detector, effects, 3))


def ranges(rays, detector, effects=ALL):
    return simulate(ROOM, rays, physics=Physics(detector, effects, 3))[0].range_m


def expected(lists, detector):
    counts = Counts(FirstHits.of(ROOM, 0, detector, lists, build_casters(ROOM)[0]))
    return np.stack([counts.pulses, counts.signal, counts.per_bin, counts.haze_per_pulse[0]])


@both
def test_each_of_two_sensors_has_the_light_of_one_alone(detector):
    alone, pair = histograms(fan(), detector), histograms(two_sensors(), detector)
    np.testing.assert_array_equal(pair.counts[:40], alone.counts)
    np.testing.assert_array_equal(pair.pulses, np.tile(alone.pulses, 2))
    steady = frozenset({"quantisation"})
    np.testing.assert_array_equal(
        histograms(two_sensors(), detector, steady).counts[40:], histograms(fan(40, 1), detector, steady).counts
    )
    np.testing.assert_array_equal(expected([two_sensors()], detector)[:, :40], expected([fan()], detector))


@both
def test_light_goes_with_its_sensor_in_any_order_of_rays_and_by_any_number(detector):
    order, steady = np.random.default_rng(0).permutation(80), frozenset({"quantisation"})
    uneven = of_sensors(two_sensors(), np.arange(80) >= 13)
    counts = histograms(uneven, detector, steady).counts
    np.testing.assert_array_equal(histograms(uneven.subset(order), detector, steady).counts, counts[order])
    renamed = of_sensors(uneven, 7 - 5 * uneven.sensor)
    np.testing.assert_array_equal(ranges(renamed, detector), ranges(uneven, detector))


@both
def test_one_emitter_for_all_makes_no_difference_between_sensors(detector):
    shared = replace(detector, emitters="shared")
    one = of_sensors(two_sensors(), np.zeros(80))
    known = ranges(one, detector)
    assert np.isfinite(known).sum() > 0
    np.testing.assert_array_equal(ranges(two_sensors(), shared), known)
    np.testing.assert_array_equal(ranges(replace(two_sensors(), light=np.full(80, 9.0)), shared), known)
    plans = [Planner(which).plan(ROOM, [rays]) for which, rays in ((shared, two_sensors()), (detector, one))]
    assert plans[0] == plans[1]


@both
def test_rays_with_more_light_are_those_of_a_stronger_laser(detector):
    bright = replace(fan(), light=np.full(40, 4.0))
    stronger = replace(detector, photons=replace(detector.photons, pulse_energy_j=4 * detector.photons.pulse_energy_j))
    np.testing.assert_array_equal(histograms(bright, detector).counts, histograms(fan(), stronger).counts)
    np.testing.assert_array_equal(expected([bright], detector), expected([fan()], stronger))


def test_light_stays_with_rays_that_are_picked_or_joined():
    bright = replace(fan(4), light=np.arange(1.0, 5.0))
    assert bright.subset(np.array([2, 0])).light.tolist() == [3, 1]
    assert Rays.joined([fan(2), bright]).light.tolist() == [1, 1, 1, 2, 3, 4]
    assert Rays.joined([fan(2), fan(2)]).light is None


class TestDevicesOfBaselines:
    def test_share_their_rays_alternately_with_the_mean_light(self):
        lit = replace(two_sensors(3), light=np.repeat([0.5, 1.5], 3))
        (fired,) = assign_devices((fan(5),), Devices.of((lit,)))
        assert fired.sensor.tolist() == [0, 1, 0, 1, 0]
        assert (fired.light == 1).all()

    def test_change_neither_the_rays_of_one_device_nor_those_of_sensors(self):
        one, several = (fan(),), (two_sensors(),)
        assert assign_devices(one, ONE_DEVICE) is one
        assert assign_devices(several, Devices(3)) is several

    def test_are_as_many_as_the_design_s_sensors(self):
        request = make_request()
        designs = [
            DesignSpec(f"of-{count}", tuple(normal_sensor(name=f"s{i}") for i in range(count))) for count in (1, 3)
        ]
        baselines = [one for one in entries_of(replace(request, designs=designs, rays=[12])) if one.baseline]
        assert {one.devices.number for one in baselines if one.matched_to is None} == {3}
        numbers = {(one.matched_to, one.devices.number) for one in baselines if one.matched_to}
        assert numbers == {("of-1", 1), ("of-3", 3)}
        assert len(np.unique(baselines[0].lit_in(0)[0].sensor)) == 3
