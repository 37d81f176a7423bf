"""Real parts: what their files say, where their rays go, and how they stand in the design space."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.command_line import make_run

from lidardesign.errors import ConfigError
from lidardesign.fitting.part_shapes import PartShape, gate_inside, shapes_of
from lidardesign.formats.designs import load_design
from lidardesign.mixture.components import Axes
from lidardesign.parts.catalogue import (
    FOLDER,
    Pose,
    find_part,
    interleaved,
    load_library,
    part_design,
    part_rays,
    part_sensor,
    parts_for,
    side_by_side,
)
from lidardesign.parts.part import conditions_of, disagreements, to_angles, to_directions
from lidardesign.parts.statements import FIELDS, Statement
from lidardesign.sensors.design_file import save_design
from lidardesign.sensors.pattern import even_subset
from lidardesign.sensors.sensor import boresight_frame
from lidardesign.space import FARTHEST_M, DesignSpace, direction

LIBRARY = load_library()
PARTS = {part.name: part for part in LIBRARY.every_mode()}
SOME = ("vl53l8cx", "tmf8820:wide", "vlp-16", "hdl-64e", "tim781", "mid-40", "mid-360", "ml30s", "azure-kinect")
OWN = """
schema_version: 1
maker: Us
product: Homemade
kind: multi-zone
summary: A ranger of our own.
sources:
  bench: {title: Our bench, kind: measurement}
pattern:
  - {kind: zones, columns: 3, rows: 2, source: bench}
field_of_view_deg:
  - {azimuth: [-15, 15], elevation: [-10, 10], source: bench}
near_m:
  - {value: 0.1, source: bench}
far_m:
  - {value: 2.5, source: bench, reflectance_percent: 50, illuminance_klux: 1}
  - {value: 1.5, source: bench, reflectance_percent: 10, illuminance_klux: 1}
rate_hz:
  - {value: 20, source: bench}
"""


@pytest.fixture
def own(tmp_path):
    path = tmp_path / "homemade.yaml"
    path.write_text(OWN)
    return path


def some_pose(seed: int = 1) -> Pose:
    values = np.random.default_rng(seed).uniform(-1, 1, 6)
    return Pose(values[:3], *(values[3:] * [3, 1.4, 3]))


# what the files say


def in_field(part, directions):
    """Which unit vectors in a part's frame lie in its field of view, ends included."""
    angles_deg = np.degrees(to_angles(part.projection, directions))
    low, high = np.array([part.view.azimuth, part.view.elevation]).T
    away = np.abs(angles_deg - (low + high) / 2)
    if part.view.shape == "ellipse":
        return np.square(away / np.maximum((high - low) / 2, 1e-9)).sum(axis=1) <= 1 + 1e-9
    return (away <= (high - low) / 2 + 1e-9).all(axis=1)


@pytest.mark.parametrize("name", LIBRARY.names)
def test_every_source_of_a_part_is_used_and_every_statement_has_one(name):
    file = LIBRARY.files[name]
    modes = list(file.modes) or [None]
    used = {one.source for mode in modes for statements in file.figures(mode).values() for one in statements}
    assert used == set(file.sources)


@pytest.mark.parametrize("name", PARTS)
def test_the_rays_of_a_part_are_unit_vectors_inside_its_field_and_as_many_as_it_says(name):
    part = PARTS[name]
    assert np.allclose(np.linalg.norm(part.directions, axis=1), 1, atol=1e-12)
    assert in_field(part, part.directions).all()
    assert len(part.directions) == part.rays
    assert len(np.unique(np.round(part.directions, 9), axis=0)) == part.rays
    columns, rows = part.grid
    assert columns * rows >= part.rays > (columns - 1) * (rows - 1)
    if stated := part.value("points_per_s"):
        assert part.rays * part.rate_hz == pytest.approx(stated, rel=0.001)


@pytest.mark.parametrize("name", PARTS)
def test_a_part_fills_its_field_up_to_one_cell(name):
    part = PARTS[name]
    if part.rays == 1:
        return
    reached = np.degrees(np.ptp(to_angles(part.projection, part.directions), axis=0))
    for width, found, cells in zip(np.degrees(part.field_of_view_rad), reached, part.grid, strict=True):
        # rosettes and pixels are not even: their outermost cells are wider or reached only now and then
        assert found <= width + 1e-9
        assert found >= width * (1 - 2.5 / max(cells, 2.6)) - 1e-9


@given(st.floats(1, 120), st.floats(1, 120), st.integers(1, 9), st.integers(1, 9))
def test_a_module_is_even_zones_of_its_field_and_measures_at_any_range(across, up, columns, rows):
    name = f"module-{across:.3f}x{up:.3f}-{columns}x{rows}"
    part = find_part(name)
    assert (part.name, part.grid, part.rays) == (name, (columns, rows), columns * rows)
    half = np.radians([float(f"{across:.3f}"), float(f"{up:.3f}")]) / 2
    angles = to_angles("tangent", part.directions)
    steps = [2 * half[0] / columns, 2 * half[1] / rows]
    np.testing.assert_allclose(np.unique(np.round((angles + half) / steps - 0.5, 6), axis=0)[:, 0].max(), columns - 1)
    np.testing.assert_allclose(np.abs(angles).max(axis=0), half * (1 - 1 / np.array([columns, rows])), atol=1e-9)
    assert part.range_m[0] == 0.0
    assert part.range_m[1] == FARTHEST_M


@pytest.mark.parametrize(
    "name", ["module-45-8x8", "module-45x45", "module-x-8x8", "module-45x45-0x8", "module-45x200-8x8"]
)
def test_a_module_without_a_possible_field_or_zones_is_refused(name):
    with pytest.raises(ConfigError) as refused:
        find_part(name)
    assert refused.value.allowed


def test_beams_of_a_spinning_scanner_include_the_ends_and_its_columns_do_not_repeat():
    azimuth, elevation = to_angles("sphere", PARTS["vlp-16"].directions).T
    assert np.unique(np.round(np.degrees(elevation), 9)) == pytest.approx(np.arange(-15, 16, 2))
    columns = np.unique(np.round(np.degrees(azimuth), 9))
    assert len(columns) == 1800
    assert np.ptp(np.diff(columns)) < 1e-6
    assert columns[0] + 360 - columns[-1] == pytest.approx(0.2)


def test_a_sweep_of_less_than_a_turn_has_its_ends():
    azimuth = np.degrees(to_angles("sphere", PARTS["tim781"].directions)[:, 0])
    assert (azimuth.min(), azimuth.max()) == pytest.approx((-135, 135))
    assert np.diff(np.sort(azimuth)) == pytest.approx(1 / 3)


def test_pixels_are_even_on_the_focal_plane():
    forward, left, up = PARTS["azure-kinect"].directions.T
    for across, count, half_deg in ((left / forward, 320, 37.5), (up / forward, 288, 32.5)):
        steps = np.diff(np.unique(np.round(across, 9)))
        assert len(steps) == count - 1
        assert steps == pytest.approx(2 * math.tan(math.radians(half_deg)) / count, rel=1e-4)


def test_a_rosette_is_the_sum_of_two_turning_deflections():
    pattern = PARTS["mid-40"].pattern
    points = np.degrees(to_angles("tangent", PARTS["mid-40"].directions))
    first, second = pattern.deflection_deg
    radius = np.linalg.norm(points, axis=1)
    assert radius.max() == pytest.approx(first + second, rel=1e-3)
    assert radius.min() == pytest.approx(abs(first - second), abs=0.1)
    time_s = np.arange(len(points)) / pattern.points_per_s
    turned = points[:, 0] + 1j * points[:, 1]
    for hertz, deflection in zip(pattern.rotor_hz, pattern.deflection_deg, strict=True):
        # as a naive Fourier coefficient at the rotor's frequency; the other one leaks by what 0.1 s cannot part
        assert abs((turned * np.exp(-2j * np.pi * hertz * time_s)).mean()) == pytest.approx(deflection, rel=0.05)


def test_a_pattern_that_is_not_published_is_even_per_solid_angle():
    elevation = to_angles("sphere", PARTS["mid-360"].directions)[:, 1]
    low, high = np.sin(np.radians([-7, 52]))
    for split in (0.1, 0.5, 0.8):
        share = (np.sin(elevation) < low + split * (high - low)).mean()
        assert share == pytest.approx(split, abs=0.002)


def test_an_unpublished_pattern_in_a_round_field_is_even_over_its_disc(own):
    text = OWN.replace("kind: zones, columns: 3, rows: 2", "kind: even, rays: 3000")
    own.write_text(text.replace("elevation: [-10, 10]", "elevation: [-10, 10], shape: ellipse"))
    part = find_part(own)
    across, up = np.degrees(to_angles(part.projection, part.directions)).T
    radius = np.hypot(across / 15, up / 10)
    assert radius.max() <= 1
    for inner in (0.3, 0.5, 0.9):
        assert (radius < inner).mean() == pytest.approx(inner**2, abs=0.01)
    assert (across > 0).mean() == pytest.approx(0.5, abs=0.01)
    assert (up > 0).mean() == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("projection", ["tangent", "sphere", "plane"])
def test_angles_and_directions_undo_each_other(projection):
    angle = np.random.default_rng(0).uniform(-1.2, 1.2, (200, 2))
    assert np.allclose(to_angles(projection, to_directions(projection, angle)), angle, atol=1e-12)


def test_histograms_and_processed_results_cost_what_their_bits_make():
    tmf, vl53 = PARTS["tmf8820"], PARTS["vl53l5cx"]
    assert tmf.histogram_mbps == pytest.approx(128 * 24 * 10 * 30 / 1e6)
    assert tmf.processed_mbps is None
    assert vl53.processed_mbps == pytest.approx((256 + 64 + 256 + 256 + 128 + 128 + 64 + 64 + 140) * 8 * 15 / 1e6)
    assert vl53.histogram_mbps is None


# conditions and contradictions


def test_one_source_with_several_figures_does_not_disagree_with_itself(own):
    first, two_sources = "  - {value: 0.1, source: bench}", "  list: {title: A list, kind: list}\n  bench: {"
    for further, source, expected in ((0.1, "bench", []), (0.2, "bench", []), (0.2, "list", ["near_m"])):
        text = OWN.replace(first, f"{first}\n  - {{value: {further}, source: {source}}}")
        own.write_text(text if source == "bench" else text.replace("  bench: {", two_sources))
        assert disagreements(find_part(own)) == expected


def test_the_range_under_conditions_is_the_farthest_that_a_source_vouches_for():
    part = PARTS["vl53l5cx"]
    assert part.under(reflectance_percent=88, illuminance_klux=0).range_m == (0.02, 3.5)
    assert part.under(reflectance_percent=50, illuminance_klux=2).range_m == (0.02, 0.8)
    assert part.under(illuminance_klux=5).range_m == (0.02, 1.1)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(PARTS)), st.floats(0.1, 100), st.floats(0, 120), st.floats(1, 10), st.floats(0, 1))
def test_darker_targets_and_more_light_never_lengthen_a_range(name, reflectance, klux, brighter, dimmer):
    part = PARTS[name]
    try:
        hard = part.under(reflectance_percent=reflectance, illuminance_klux=klux)
    except ConfigError:
        return
    easy = part.under(reflectance_percent=min(reflectance * brighter, 100), illuminance_klux=klux * dimmer)
    assert easy.range_m[1] >= hard.range_m[1]
    assert hard.range_m[1] in [one.value for one in part.figures["far_m"]]


def test_conditions_that_no_source_states_are_refused_with_those_that_are():
    with pytest.raises(ConfigError, match="no source of vl53l5cx states a range at 5 % reflectance") as caught:
        PARTS["vl53l5cx"].under(reflectance_percent=5)
    assert "17 % reflectance, darkness" in str(caught.value)
    assert conditions_of(PARTS["tfmini-i"].figures["far_m"][0]) == "90 % reflectance, 70 klux"


# placing


@pytest.mark.parametrize("name", SOME)
def test_a_pose_moves_a_part_as_a_rigid_body(name):
    part, pose = PARTS[name], some_pose()
    here = part_rays(part, Pose(), min(part.rays, 60))
    there = part_rays(part, replace(pose, origin_m=pose.origin_m), min(part.rays, 60))
    assert np.allclose(there.origin_m, pose.origin_m)
    # the subset may differ between poses, but every ray is one of the part's own, turned
    local = there.direction @ pose.frame.T
    assert in_field(part, local).all()
    nearest = (local @ part.directions.T).max(axis=1)
    assert nearest.min() > 1 - 1e-12
    assert len(np.unique(np.round(local, 9), axis=0)) == len(there) == len(here)


@pytest.mark.parametrize("name", PARTS)
def test_the_sensor_of_a_part_has_its_field_its_range_and_looks_at_its_centre(name):
    part, pose = PARTS[name], some_pose(3)
    sensor = part_sensor(part, pose)
    assert sensor.field_of_view_rad == pytest.approx(part.field_of_view_rad)
    assert sensor.gate_m == pytest.approx(part.range_m)
    assert np.allclose(sensor.frame, boresight_frame(*part.centre_rad) @ pose.frame, atol=1e-9)
    assert sensor.origin_covariance_m2 is None
    assert sensor.part == name


def test_rays_of_one_part_fire_over_its_own_frame():
    rays = part_rays(PARTS["tim781"], Pose())
    assert rays.time_s[0] == 0
    assert rays.time_s[-1] == pytest.approx((1 - 1 / 811) / 15)


# subsets and several parts


def test_a_quarter_of_the_zones_is_one_of_every_block_of_four():
    kept = even_subset(PARTS["vl53l5cx"].directions, 16)
    blocks = {(index // 8 // 2, index % 8 // 2) for index in kept}
    assert len(blocks) == 16


@pytest.mark.parametrize(("count", "parts", "shares"), [(64, 1, [64]), (65, 2, [33, 32]), (196, 4, [49, 49, 49, 49])])
def test_more_rays_than_a_part_has_take_more_parts_that_share_them(count, parts, shares):
    part = PARTS["vl53l8cx"]
    assert parts_for(part, count) == parts
    rays = part_rays(part, interleaved(part, Pose(), parts), count)
    assert np.bincount(rays.sensor).tolist() == shares


def test_four_interleaved_parts_of_eight_by_eight_zones_have_sixteen_by_sixteen():
    part = PARTS["vl53l8cx"]
    rays = part_rays(part, interleaved(part, Pose(), 4))
    found = np.degrees(to_angles("tangent", rays.direction))
    wanted = (np.arange(16) + 0.5) * 45 / 16 - 22.5
    distance = np.abs(found[:, :, None] - wanted).min(axis=2)
    # turning a part about its own axes is not quite a shift in its tangent plane
    assert distance.max() < 0.2
    assert len(np.unique(np.abs(found[:, :, None] - wanted).argmin(axis=2), axis=0)) == 256


def test_parts_beside_each_other_look_a_field_of_view_apart():
    part = PARTS["vl53l8cx"]
    poses = side_by_side(part, some_pose(), 2)
    assert math.acos(poses[0].frame[0] @ poses[1].frame[0]) == pytest.approx(math.radians(45))
    middle = poses[0].frame[0] + poses[1].frame[0]
    assert np.allclose(middle / np.linalg.norm(middle), some_pose().frame[0])


def test_spinning_scanners_stand_above_each_other_and_line_scanners_are_rolled():
    above = side_by_side(PARTS["vlp-16"], Pose(), 2)
    assert [pose.elevation_rad for pose in above] == pytest.approx([math.radians(-15), math.radians(15)])
    rolled = side_by_side(PARTS["tim781"], Pose(), 3)
    assert [pose.roll_rad for pose in rolled] == pytest.approx([0, math.pi / 3, 2 * math.pi / 3])


# designs


def test_a_part_in_a_run_is_fitted_anew_with_chosen_rays_and_no_fit_has_its_layout(call, tmp_path):
    run = make_run(tmp_path / "run")
    design = run / "designs" / "bought.yaml"
    design.parent.mkdir()
    save_design(replace(part_design(PARTS["vl53l8cx"], Pose()), provenance={"run": ".."}), design)
    result = call("constrain", design, "--name", "like", "--json")
    assert result.code == 0, result.err
    again = load_design(run / "designs" / "like.yaml")
    assert (again.layout, again.counts, len(again.sensors)) == ("chosen", [64], 1)
    assert call("fit", run, "--layout", "fixed").code == 2


# the library


def test_an_own_part_is_found_by_its_path_its_folder_and_its_name(own, tmp_path):
    assert find_part(own).product == "Us Homemade"
    assert find_part(str(own)).range_m == (0.1, 2.5)
    library = load_library([tmp_path])
    assert "homemade" in library.names
    assert library.part("homemade").origin == str(own)
    assert len(library.names) == len(LIBRARY.names) + 1


def test_an_own_part_stands_in_for_a_shipped_one_of_its_name(tmp_path):
    path = tmp_path / "vlp-16.yaml"
    path.write_text(OWN)
    assert load_library([path]).part("vlp-16").product == "Us Homemade"
    assert LIBRARY.part("vlp-16").product == "Velodyne VLP-16"


def test_a_mode_is_named_behind_a_name_or_a_path(tmp_path):
    path = tmp_path / "copy.yaml"
    path.write_text((FOLDER / "vl53l5cx.yaml").read_text())
    assert find_part(f"{path}:4x4").rays == find_part("vl53l5cx:4x4").rays == 16
    assert find_part("vl53l5cx:8x8").name == "vl53l5cx"


def test_two_own_parts_of_one_name_are_refused(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "same.yaml").write_text(OWN)
    with pytest.raises(ConfigError, match="is a second part called 'same'"):
        load_library([tmp_path / "a", tmp_path / "b"])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("vlp16", "there is no part 'vlp16'"),
        ("vlp-16:4x4", "vlp-16 has no mode '4x4'"),
        ("vl53l5cx:9x9", "vl53l5cx has no mode '9x9'"),
        ("vl53l5cx:", "vl53l5cx has no mode ''"),
        ("", "there is no part ''"),
        ("nowhere/part.yaml", "cannot be read"),
        ("no such.yaml", "'no such' is not a name of a part"),
    ],
)
def test_names_that_lead_nowhere_are_refused(name, message):
    with pytest.raises(ConfigError, match=message):
        find_part(name)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("kind: multi-zone", "kind: sonar", r"homemade.yaml:5:7: kind: found 'sonar'"),
        ("rows: 2", "rows: 0", r"rows"),
        ("rows: 2, source: bench", "rows: 2, source: nobody", "names the source 'nobody', known are bench"),
        ("[-15, 15]", "[15, -15]", "azimuth runs from 15 down to -15"),
        ("value: 0.1,", "value: 3,", "near_m is not below far_m"),
        ("value: 0.1,", "value: -1,", "near_m"),
        ("value: 20,", "value: 0,", "rate_hz"),
        ("rate_hz:\n  - {value: 20, source: bench}\n", "", "rate_hz is missing"),
        ("reflectance_percent: 50", "reflectance_percent: 150", "reflectance_percent"),
        ("reflectance_percent: 50", "reflectance: 50", r"homemade.yaml:16:\d+: unknown key"),
        ("far_m:", "far:", r"unknown key 'far'"),
        ("kind: zones", "kind: spiral", "pattern"),
        ("zones, columns: 3, rows: 2", "rings, columns: 3", "give either rings or elevations_deg"),
        ("zones, columns: 3, rows: 2", "zones, columns: 3000, rows: 3000", "9000000 rays a frame"),
        ("zones, columns: 3, rows: 2", "rings, columns: 3, elevations_deg: [0, 11]", "a beam at 11 deg"),
        ("elevation: [-10, 10]", "elevation: [0, 0]", "2 rays across an elevation without width"),
        ("azimuth: [-15, 15]", "azimuth: [-180, 180]", "beyond 180 degrees from the forward axis"),
        ("elevation: [-10, 10]", "elevation: [-10, 10], shape: ellipse", "its pattern has corners"),
        ("product: Homemade", 'product: "\\x1b[2J"', "product"),
    ],
)
def test_a_part_file_that_cannot_be_is_refused_where_it_is_wrong(own, old, new, message):
    assert old in OWN
    own.write_text(OWN.replace(old, new, 1))
    with pytest.raises(ConfigError, match=message):
        assert find_part(own).directions.size < 0


@pytest.mark.parametrize("text", ["", "[]", "just words", "{}", "a: *b", "far_m: 3", "modes: {x: 3}", "pattern: [[]]"])
def test_files_that_are_no_parts_are_refused(own, text):
    own.write_text(text)
    with pytest.raises(ConfigError):
        find_part(own)


# the commands


def test_the_list_under_conditions_leaves_out_what_no_source_vouches_for(call):
    result = call("catalog", "list", "--reflectance", "10", "--klux", "100", "--json")
    names = [entry["name"] for entry in result.json["parts"]]
    assert "mid-40" in names
    assert "vl53l5cx" not in names
    assert result.json["left_out"] == len(PARTS) - len(names)
    assert "have no range stated" in result.err


def test_a_part_is_shown_with_every_source_and_what_they_disagree_about(call):
    shown = call("catalog", "show", "vlp-16").out
    for text in ("velodyne_description", "HELIOS++", "0.09144", "sources disagree about", "28800 rays"):
        assert text in shown
    document = call("catalog", "show", "vlp-16", "--json").json
    assert [one["value"] for one in document["figures"]["far_m"]] == [100, 100, 130]
    assert document["disagreements"] == disagreements(PARTS["vlp-16"])


def test_a_part_is_written_as_a_design_that_other_commands_read(call, tmp_path):
    result = call(
        "catalog", "show", "vl53l8cx", "--out", "bought.yaml", "--rays", "196", "--at-origin", "-1,0,0.5",
        "--azimuth-deg", "-20", "--elevation-deg", "10", "--json",
    )  # fmt: skip
    assert result.json["design_rays"] == 196
    assert result.json["sensors"] == 4
    design = load_design(tmp_path / "bought.yaml")
    part = PARTS["vl53l8cx"]
    pose = Pose(np.array([-1, 0, 0.5]), math.radians(-20), math.radians(10))
    wanted = part_rays(part, interleaved(part, pose, 4), 196)
    assert np.allclose(design.rays().direction, wanted.direction, atol=1e-12)
    beside = call("catalog", "show", "vl53l8cx", "--out", "wide.yaml", "--parts", "2", "--arrange", "beside", "-q")
    assert (beside.code, beside.out) == (0, "wide.yaml\n"), beside.err
    one, other = load_design(tmp_path / "wide.yaml").sensors
    assert math.acos(one.boresight @ other.boresight) == pytest.approx(math.radians(45))
    assert one.elevation_rad == other.elevation_rad == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--rays", "10"), "says how a design is made"),
        (("--at-origin", "0,0,0"), "says how a design is made"),
        (("--out", "o.yaml", "--at-origin", "1,2"), "three numbers"),
        (("--out", "o.yaml", "--elevation-deg", "91"), "90"),
        (("--out", "o.yaml", "--azimuth-deg", "361"), "360"),
        (("--out", "o.yaml", "--roll-deg", "nan"), "--roll-deg"),
        (("--out", "o.yaml", "--arrange", "beside"), "is for several parts"),
        (("--out", "o.yaml", "--arrange", "stacked", "--parts", "2"), "interleaved"),
        (("--out", "o.yaml", "--parts", "2", "--rays", "129"), "129 rays of 2 x vl53l8cx"),
        (("--out", "o.yaml", "--parts", "1000"), "--rays N takes an evenly spread subset"),
        (("--reflectance", "0"), "--reflectance"),
        (("--klux", "-1"), "--klux"),
        (("--reflectance", "5"), "no source of vl53l8cx states a range"),
    ],
)
def test_what_cannot_be_asked_of_a_part_is_refused_and_nothing_is_written(call, options, message):
    result = call("catalog", "show", "vl53l8cx", *options)
    assert result.code == 2
    assert message in result.err
    assert not Path("o.yaml").exists()


# the guide

GUIDE = (Path(__file__).parents[2] / "docs" / "catalog.md").read_text(encoding="utf-8")


def test_the_part_file_of_the_guide_is_one(tmp_path):
    (text,) = re.findall(r"```yaml\n(.*?)```", GUIDE, re.DOTALL)
    path = tmp_path / "ranger.yaml"
    path.write_text(text)
    fine, fast = find_part(path), find_part(f"{path}:fast")
    assert (fine.rays, fast.rays) == (6, 3)
    assert fine.histogram_mbps == pytest.approx(6 * 64 * 16 * 20 / 1e6)
    assert fine.under(reflectance_percent=50, illuminance_klux=1).range_m == (0.05, 0.9)


def test_the_guide_names_every_key_and_every_kind_of_pattern():
    keys = set(re.findall(r"`([a-z_]+)`", GUIDE))
    patterns = {part.pattern.kind for part in PARTS.values()} | {"raster"}
    assert {*FIELDS, *Statement.model_fields, *patterns} - {"value"} <= keys


def test_the_ranges_of_the_guide_are_the_parts(call):
    rows = re.findall(r"\| `vl53l5cx( --[^`]*)`? ?\| ([\d.]+) - ([\d.]+) m", GUIDE)
    assert len(rows) == 2
    for options, start, end in rows:
        shown = call("catalog", "show", "vl53l5cx", *options.split(), "--json").json
        assert shown["range_m"] == {"near": float(start), "far": float(end)}
    assert PARTS["vl53l5cx"].range_m == (0.02, 3.5)


def test_a_shape_is_where_its_component_looks_upright_and_turned():
    space = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 4.0))
    upright, turned = shapes_of(find_part("tmf8828"), space)
    axes = Axes.of(space)
    for shape in (upright, turned):
        pose = shape.pose(np.zeros(3), 0.3, 0.2, 0.1, axes)
        np.testing.assert_allclose(pose.frame[0], direction(0.3, 0.2), atol=1e-12)
    across = turned.pose(np.zeros(3), 0.0, 0.0, 0.0, axes)
    np.testing.assert_allclose(across.frame[1], [0, 0, 1], atol=1e-12)


def test_a_part_whose_range_does_not_meet_the_spaces_has_no_shape():
    near = DesignSpace((0, 0, 0, -0.5, -0.5, 0.05), (0, 0, 0, 0.5, 0.5, 0.5))
    assert shapes_of(find_part("vlp-16"), near) == []
    assert isinstance(shapes_of(find_part("vl53l5cx"), near)[0], PartShape)
    held = DesignSpace((0, 0, 0, -0.5, -0.5, 0.3), (0, 0, 0, 0.5, 0.5, 0.3))
    assert gate_inside(find_part("vl53l5cx"), held) == find_part("vl53l5cx").range_m
    assert gate_inside(find_part("vlp-16"), held) is None
