"""Light of real parts: what data sheets state is what is simulated; what they do not state is unknown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidardesign.parts.catalogue import Pose, find_part, part_design, parts_of
from lidardesign.scenes.scene import Ambient, Body, Scene, Sphere
from lidardesign.simulate.calibration import (
    BENCH_EFFECTS,
    Claim,
    light_notes,
    part_light,
    reach_notes,
    reach_of,
    reaches_of,
    with_part_light,
)
from lidardesign.simulate.detector.files import load_detector
from lidardesign.simulate.detector.physics import IDEAL, Physics
from lidardesign.simulate.returns import simulate

ZONES = load_detector("consumer-8x8")
REPEATS = 12
RANGER = """\
schema_version: 1
maker: Example
product: Ranger
kind: multi-zone
summary: Zones.
sources: {bench: {title: Ours, kind: measurement}}
pattern: [{kind: zones, columns: 6, rows: 6, source: bench}]
field_of_view_deg: [{azimuth: [-20, 20], elevation: [-20, 20], source: bench}]
rate_hz: [{value: 10, source: bench}]
far_m:
  - {value: 3.0, source: bench}
  - {value: 2.0, source: bench, reflectance_percent: 40, illuminance_klux: 1, detection_percent: 90}
  - {value: 0.9, source: bench, reflectance_percent: 18, illuminance_klux: 20, detection_percent: 90}
"""


@pytest.fixture
def ranger(tmp_path) -> Path:
    path = tmp_path / "ranger.yaml"
    path.write_text(RANGER, encoding="utf-8")
    return path


def detected_share(design, range_m, reflectance, klux, detector, count=None):
    """Share of a design's rays that see the inside of a ball around it."""
    scene = Scene((Body(Sphere(range_m), reflectance=reflectance),), ambient=Ambient(1000.0 * klux))
    rays = with_part_light(design.rays(count), design, detector)
    found = [simulate(scene, rays, physics=Physics(detector, BENCH_EFFECTS, 1, number))[0] for number in range(REPEATS)]
    return np.mean([one.body == 0 for one in found])


def of_part(part, parts=1, names=()):
    design = part_design(part, [Pose()] * parts)
    return replace(design, constraints={"parts": {"names": [str(name) for name in names]}}) if names else design


@pytest.mark.parametrize("count", [None, 16], ids=["all rays", "16 rays"])
@pytest.mark.parametrize(
    ("name", "range_m", "reflectance"), [("vl53l5cx", 1.1, 0.88), ("vl53l5cx:4x4", 1.7, 0.88), ("tmf8828", 1.3, 0.9)]
)
def test_at_the_stated_range_and_light_half_of_the_rays_return(name, range_m, reflectance, count):
    share = detected_share(of_part(find_part(name)), range_m, reflectance, 5, ZONES, count)
    assert share == pytest.approx(0.5, abs=0.15)


def test_a_stated_share_is_that_of_the_rays_whatever_the_detector_and_the_number_of_parts(ranger):
    part, scanned = find_part(ranger), load_detector("single-photon")
    for design, detector in ((of_part(part, 1, [ranger]), scanned), (of_part(part, 3, [ranger]), ZONES)):
        assert detected_share(design, 0.9, 0.18, 20, detector) == pytest.approx(0.9, abs=0.08)


def test_light_is_the_detector_s_own_where_nothing_is_stated_or_nothing_counted():
    unknown, known = of_part(find_part("vl53l8cx")), of_part(find_part("vl53l5cx"))
    assert with_part_light(unknown.rays(), unknown, ZONES).light is None
    assert with_part_light(known.rays(), known, IDEAL).light is None
    assert part_light(find_part("mid-40"), ZONES, 100) is None  # 260 m are beyond its next pulse
    assert "vl53l8cx" in light_notes(unknown, ZONES)[0]
    assert "own" not in light_notes(known, ZONES)[0]
    assert light_notes(known, replace(ZONES, emitters="shared")) == light_notes(known, IDEAL) == []


def test_reaches_are_stated_reckoned_or_unknown():
    assert reach_of(find_part("mid-40")).sunny_m == 260
    reckoned = reach_of(find_part("vl53l5cx"))
    assert reckoned.dark_m == 3.5
    assert 0.1 < reckoned.sunny_m < 1.0
    # 70 klux are not full sun, and no shipped detector is like it
    assert reach_of(find_part("tfmini-i")).sunny_m is None
    assert "unknown / unknown" in reach_of(find_part("vl53l8cx")).as_text().values()


def test_the_brightest_statement_counts_and_a_gate_beyond_any_is_noted(ranger):
    design = of_part(find_part(ranger), 1, [ranger])
    assert [part.name for part in parts_of(design)] == ["ranger"]
    assert reaches_of(design)[0].dark_m == 2.0
    claim = Claim.of(find_part(ranger))
    assert (claim.range_m, claim.reflectance, claim.klux, claim.share) == (0.9, 0.18, 20, 0.9)
    (note,) = reach_notes(design)
    assert "listens to 3 m" in note
    assert not reach_notes(of_part(find_part("vl53l5cx")))
    assert parts_of(of_part(find_part(ranger))) == [None]
