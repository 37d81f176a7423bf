"""Designs in a captured scan: a ray hears its pixel inside its gate and nothing else."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from support.captures import BALL_AT, BALL_M, BIN_PS, C_M_PER_PS, START_PS, ball_range_m, make_capture
from support.command_line import caller
from support.rays import rays_along
from support.sensors import normal_sensor

from lidardesign.errors import ConfigError, DataError
from lidardesign.evaluation.captures.capture import Capture, load_capture
from lidardesign.evaluation.captures.scan import (
    Captured,
    Estimation,
    default_within_rad,
    gate_bins,
    scan,
    scan_pixels,
    uniform_rays,
    whole_window,
)
from lidardesign.evaluation.captures.score import CaptureSettings, evaluate_capture
from lidardesign.formats.galvo import degree_frame, scan_directions, write_galvo
from lidardesign.sensors.design import DesignSpec
from lidardesign.sensors.design_file import save_design
from lidardesign.simulate.detector import physics

BIN_M = BIN_PS * C_M_PER_PS / 2
ESTIMATIONS = [Estimation("peak"), Estimation("matched")]
EACH_ESTIMATOR = pytest.mark.parametrize("estimation", ESTIMATIONS, ids=lambda one: one.estimator)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures")
    made = {"clean": {}, "noisy": {"outliers": 0.1}, "untrue": {"outliers": 0.1, "truth": False}}
    for name, options in made.items():
        np.savez_compressed(folder / f"{name}.npz", **make_capture(**options))
    return folder


@pytest.fixture(scope="module")
def clean(files):
    return load_capture(files / "clean.npz")


@pytest.fixture(scope="module")
def noisy(files):
    return load_capture(files / "noisy.npz")


def ball_design(rays=150):
    ahead = normal_sensor("ball", spread_rad=(0.1, 0.1), range_m=0.52, spread_range_m=0.042)
    return DesignSpec("ball", (ahead,), constraints={"budget": {"rays": rays}})


def looking(scan_deg, gate_m=(0.3, 2.0), **places):
    directions = scan_directions(degree_frame(0.0, 0.0), np.array(scan_deg, dtype=float))
    return rays_along(directions, gate_m, **places)


def random_looks(generator, count):
    return scan_directions(degree_frame(0.0, 0.0), generator.uniform(-10, 10, (count, 2)))


def settings(capture, **changes):
    values = {"estimation": Estimation(), "within_rad": default_within_rad(capture), "outlier_m": 0.010, **changes}
    return CaptureSettings(**values)


# --- which pixel, which bins


def test_a_ray_takes_the_pixel_that_looks_its_way(clean):
    order = np.random.default_rng(0).permutation(len(clean))
    found = scan(clean, rays_along(clean.direction[order], (0.3, 2.0)), 1e-6, Estimation())
    np.testing.assert_array_equal(found.pixel, order)
    assert found.away_rad.max() < 1e-7


def test_rays_beside_the_pixels_take_the_nearest_and_say_how_far_it_is(clean):
    found = scan(clean, looking([[0.3, -0.4]]), np.radians(1.0), Estimation())
    assert found.pixel[0] == 480, "the middle of 31 x 31"
    assert np.degrees(found.away_rad[0]) == pytest.approx(0.5, rel=1e-4)


@pytest.mark.parametrize("gate", [(0.3, 2.0), (0.5, 0.55), (0.4501, 0.4502), (0.0, 0.1), (1.9, 50.0)])
def test_a_gate_hears_the_bins_whose_middles_lie_in_it(clean, gate):
    first, last = gate_bins(clean, np.zeros(1, dtype=int), np.array([gate]))
    middles = (START_PS + (np.arange(clean.bins) + 0.5) * BIN_PS) * C_M_PER_PS / 2
    inside = np.flatnonzero((middles >= gate[0]) & (middles < gate[1]))
    np.testing.assert_array_equal(np.arange(first[0], last[0]), inside)


@EACH_ESTIMATOR
def test_what_lies_outside_a_gate_changes_nothing(noisy, estimation):
    rays = ball_design().rays()
    within = default_within_rad(noisy)
    found = scan(noisy, rays, within, estimation)
    middles = noisy.start_m[0] + (np.arange(noisy.bins) + 0.5) * noisy.bin_m
    start, end = rays.gate_m[0]
    silenced = np.where((middles >= start) & (middles < end), noisy.counts, 0)
    quiet = replace(noisy, counts=silenced)
    # what is usual in the capture is known from all of it
    quiet.__dict__["background_per_bin"] = noisy.background_per_bin
    again = scan(quiet, rays, within, estimation)
    np.testing.assert_array_equal(found.range_m, again.range_m)
    np.testing.assert_array_equal(found.photons, again.photons)
    ranges = found.range_m[found.returned]
    assert ((ranges >= start - BIN_M) & (ranges <= end + BIN_M)).all()


@EACH_ESTIMATOR
def test_clean_histograms_give_the_true_range_to_a_bin(clean, estimation):
    found = scan_pixels(clean, estimation)
    assert found.returned.all()
    # 60 photons of 25 ps: the mean is good to 0.5 mm, the highest bin to a bin or two
    assert np.abs(found.range_m - clean.true_range_m).max() < 4 * BIN_M
    assert np.abs(found.range_m - clean.true_range_m).mean() < BIN_M
    np.testing.assert_allclose(found.points_m, found.range_m[:, None] * clean.direction, atol=1e-15)


@EACH_ESTIMATOR
def test_ranges_do_not_depend_on_how_many_are_worked_on_at_once(noisy, estimation, monkeypatch):
    rays = ball_design().rays()
    found = scan(noisy, rays, 0.1, estimation)
    monkeypatch.setattr(physics, "BINS_AT_ONCE", 100)
    again = scan(noisy, rays, 0.1, estimation)
    np.testing.assert_array_equal(found.range_m, again.range_m)
    some = np.arange(0, len(rays), 7)
    np.testing.assert_array_equal(scan(noisy, rays.subset(some), 0.1, estimation).range_m, found.range_m[some])


@EACH_ESTIMATOR
def test_pixels_may_begin_to_count_at_different_times(clean, estimation):
    cut = np.random.default_rng(4).integers(0, 40, len(clean))
    at = np.minimum(cut[:, None] + np.arange(560), 599)
    later = replace(
        clean, counts=np.take_along_axis(clean.counts, at, axis=1), start_ps=clean.start_ps + cut * clean.bin_ps
    )
    later.__dict__["background_per_bin"] = clean.background_per_bin
    rays = looking([[0, 0], [3, 4], [-10, 8], [7, -7]], gate_m=(0.42, 0.9))
    found, again = (scan(one, rays, 0.02, estimation) for one in (clean, later))
    np.testing.assert_allclose(again.range_m, found.range_m, atol=1e-12)
    np.testing.assert_array_equal(again.photons, found.photons)


@pytest.mark.parametrize("per_bin", [0.003, 0.01, 0.03])
def test_rare_background_in_a_gate_is_seldom_taken_for_a_return(per_bin):
    generator = np.random.default_rng(9)
    looks = random_looks(generator, 3000)
    counts = generator.poisson(per_bin, (3000, 800))
    # a surface in every pixel, outside of the gates
    counts[np.arange(3000)[:, None], generator.integers(300, 790, 3000)[:, None] + np.arange(5)] += 20
    dark = Capture(counts, BIN_PS, START_PS, np.zeros(3), looks, pulse_fwhm_ps=60.0)
    assert dark.background_per_bin == pytest.approx(per_bin, rel=0.3)
    rays = rays_along(looks, dark.start_m[0] + np.array([100, 140]) * dark.bin_m)
    for estimation in ESTIMATIONS:
        assert scan(dark, rays, default_within_rad(dark), estimation).returned.mean() < 0.02


# --- what is not captured


def test_rays_that_were_not_captured_return_nothing_and_say_why(clean):
    rays = looking([[0, 0], [0, 0], [40, 0], [0, 0]])
    gate, origin = rays.gate_m.copy(), rays.origin_m.copy()
    gate[1], origin[3] = (5.0, 6.0), (0.0, 0.2, 0.0)
    rays = replace(rays, origin_m=origin, gate_m=gate)
    found = scan(clean, rays, np.radians(1.0), Estimation())
    expected = [Captured.YES, Captured.OUT_OF_WINDOW, Captured.OUT_OF_FIELD, Captured.OTHER_PLACE]
    assert found.captured.tolist() == expected
    assert found.returned.tolist() == [True, False, False, False]
    (row, _, _) = evaluate_capture(clean, [("some", rays)], settings(clean)).rows
    assert row.as_dict()["not_captured"] == {"other_place": 1, "out_of_field": 1, "out_of_window": 1}


@pytest.mark.parametrize(
    ("rays", "message"),
    [
        (looking([[0, 0]], origin=(0.4, 0.0, 0.0)), r"start 0.4 m from \[0.0, 0.0, 0.0\]"),
        (looking([[30, 0]]), "point 15 degrees past"),
        (looking([[0, 0]], gate_m=(5.0, 6.0)), "no bin between 0.2998 and 2.099 m"),
    ],
)
def test_a_design_of_which_nothing_was_captured_is_refused(clean, rays, message):
    with pytest.raises(DataError, match=message):
        scan(clean, rays, np.radians(1.0), Estimation())


def test_a_single_pixel_needs_an_angle(clean):
    one = Capture(clean.counts[:1], BIN_PS, START_PS, np.zeros(3), clean.direction[:1])
    with pytest.raises(ConfigError, match="--within-deg"):
        default_within_rad(one)
    assert uniform_rays(one, 4).direction == pytest.approx(np.repeat(clean.direction[:1], 4, axis=0))
    # pixels that were captured twice are as far apart as before
    counts, looks = (np.repeat(one, 2, axis=0) for one in (clean.counts, clean.direction))
    twice = Capture(counts, BIN_PS, START_PS, np.zeros(3), looks)
    assert twice.spacing_rad == pytest.approx(clean.spacing_rad, rel=1e-6)


def test_the_matched_filter_needs_to_know_the_pulse(clean):
    with pytest.raises(DataError, match="pulse_fwhm_ps"):
        scan_pixels(replace(clean, pulse_fwhm_ps=None), Estimation("matched"))


# --- what designs make of it


def test_uniform_rays_of_a_square_capture_are_its_pixels(clean):
    found = scan(clean, uniform_rays(clean, 31 * 31), default_within_rad(clean), Estimation())
    assert sorted(found.pixel) == list(range(31 * 31))


@pytest.mark.parametrize("count", [1, 7, 576])
def test_uniform_rays_are_as_many_as_asked_for_and_all_captured(clean, count):
    found = scan(clean, uniform_rays(clean, count), default_within_rad(clean), Estimation())
    assert found.captured.tolist() == [Captured.YES] * count


def test_a_gated_capture_knows_nothing_of_rays_without_gates(clean):
    gated = replace(clean, start_ps=clean.start_ps + 20.0 * (np.arange(len(clean)) % 2))
    found = evaluate_capture(gated, [("ball", ball_design().rays())], settings(gated))
    assert [(row.design, row.gate) for row in found.rows] == [("ball", "own")]
    assert any("gated" in note for note in found.notes)


def test_gates_remove_the_false_peaks_that_lie_outside_them(noisy):
    rays = ball_design().rays()
    own, whole, uniform = evaluate_capture(noisy, [("ball", rays)], settings(noisy)).rows
    assert (own.gate, whole.gate, uniform.gate, uniform.baseline) == ("own", "whole", "whole", True)
    gated, *others = (row.as_dict() for row in (own, whole, uniform))
    assert gated["outliers"] == 0
    assert all(5 < figures["outliers_percent"] < 15 for figures in others)
    assert gated["bins_per_ray"] < 0.1 * others[0]["bins_per_ray"]
    # where both are right, the gate changes nothing
    both = own.scan.returned & ~own.outlier & ~whole.outlier
    np.testing.assert_array_equal(own.scan.range_m[both], whole.scan.range_m[both])


def test_medians_of_neighbours_stand_in_for_true_ranges(files, noisy):
    untrue = load_capture(files / "untrue.npz")
    rays = ball_design().rays()
    found = evaluate_capture(untrue, [("ball", rays)], settings(untrue))
    assert "median" in found.ranges_from
    assert found.surface_from is None
    whole = found.rows[1]
    true = evaluate_capture(noisy, [("ball", rays)], settings(noisy)).rows[1]
    inside = np.abs(np.linalg.norm(np.cross(true.scan.points_m, BALL_AT), axis=1)) < 0.08 * 0.6
    np.testing.assert_array_equal(whole.outlier[inside], true.outlier[inside])
    assert whole.chamfer_mm is None


def test_what_is_counted_before_the_pulse_left_is_no_range_of_a_pixel():
    generator = np.random.default_rng(10)
    looks = random_looks(generator, 300)
    counts = generator.poisson(0.2, (300, 400))
    counts[:, 30] += 200  # the trigger's own light, 100 bins before the pulse
    counts[:, 300] += 50
    early = Capture(counts, BIN_PS, -130 * BIN_PS, np.zeros(3), looks)
    whole = whole_window(looking([[0, 0]]), early)
    for found in (scan_pixels(early, Estimation()), scan(early, whole, 1.0, Estimation())):
        assert found.range_m == pytest.approx(170.5 * BIN_M)
    judged = evaluate_capture(early, [("one", looking([[0, 0]], gate_m=(0.1, 2.0)))], settings(early, within_rad=0.1))
    assert not any(row.outlier.any() for row in judged.rows)


def test_a_return_where_truly_nothing_is_counts_as_an_outlier(clean):
    known = clean.true_range_m.copy()
    known[480] = np.nan
    found = evaluate_capture(replace(clean, true_range_m=known), [("one", looking([[0, 0], [1, 0]]))], settings(clean))
    assert found.rows[0].outlier.tolist() == [True, False]


def test_a_reference_mesh_is_what_the_surface_is_held_against(clean, tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=BALL_M)
    ball.apply_translation(BALL_AT)
    ball.export(tmp_path / "ball.ply")
    rays = ball_design(400).rays()
    found = evaluate_capture(clean, [("ball", rays)], settings(clean, reference=tmp_path / "ball.ply"))
    own, _, uniform = found.rows
    # the scanner sees more of the ball than the design looks at
    assert own.chamfer_mm < 25
    assert uniform.chamfer_mm > 3 * own.chamfer_mm, "uniform rays also see the wall, which is no part of the ball"
    ball.apply_translation([0, 0, 5.0])
    ball.export(tmp_path / "away.ply")
    with pytest.raises(DataError, match="no part of it lies in the captured field"):
        evaluate_capture(clean, [("ball", rays)], settings(clean, reference=tmp_path / "away.ply"))


def test_fields_across_azimuth_zero_and_behind_are_one_field(tmp_path):
    import trimesh

    for azimuth in (0.0, 180.0, 359.0):
        values = make_capture(15, half_deg=12.0)
        values["boresight_azimuth_deg"] = azimuth
        np.savez(tmp_path / "s.npz", **values)
        capture = load_capture(tmp_path / "s.npz")
        ball = trimesh.creation.icosphere(subdivisions=3, radius=BALL_M)
        ball.apply_translation(0.6 * degree_frame(azimuth, 0.0)[0])
        ball.export(tmp_path / "ball.ply")
        found = evaluate_capture(
            capture, [("even", uniform_rays(capture, 100))], settings(capture, reference=tmp_path / "ball.ply")
        )
        assert found.rows[0].chamfer_mm is not None
        np.testing.assert_allclose(ball_range_m(capture.direction @ degree_frame(azimuth, 0.0).T), capture.true_range_m)


# --- the program


@pytest.fixture
def call(capsys, tmp_path, monkeypatch, files):
    run = caller(capsys, tmp_path, monkeypatch)
    save_design(ball_design(), tmp_path / "ball.yaml")
    write_galvo(ball_design(), ball_design().rays(), tmp_path / "ball.galvo.csv")
    for path in files.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return run


def test_the_program_scores_designs_and_their_exports_side_by_side(call, tmp_path):
    assert call("export", "ball.yaml", "--format", "galvo", "--out", "mirrors.csv", "--quiet").code == 0
    done = call("capture", "noisy.npz", "ball.yaml", "mirrors.csv", "--json", "--csv", "points.csv")
    assert done.code == 0, done.err
    document = json.loads(done.out)
    assert document["capture"] == "noisy.npz"
    assert document["reference"]["ranges"] == "the capture's true ranges"
    assert [(row["design"], row["gate"]) for row in document["rows"]] == [
        ("ball", "own"), ("ball", "whole"), ("mirrors", "own"), ("mirrors", "whole"), ("uniform", "whole"),
    ]  # fmt: skip
    assert all(row["rays"] == row["captured"] == 150 for row in document["rows"])
    with open(tmp_path / "points.csv", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 5 * 150
    point = next(line for line in lines if line["range_m"])
    place = np.array([float(point[f"point_{axis}_m"]) for axis in "xyz"])
    assert np.linalg.norm(place) == pytest.approx(float(point["range_m"]))
    # the table names its judges
    assert "5 mm from the median range" in call("capture", "untrue.npz", "ball.yaml", "--outlier-mm", "5").out


BAD = [
    ("capture ball.yaml ball.yaml", 3, "suffix '.yaml'"),
    ("capture clean.npz ball.yaml --estimator mean", 2, "peak, matched"),
    ("capture clean.npz ball.yaml --within-deg 0", 2, "--within-deg"),
    ("capture clean.npz ball.yaml --outlier-mm -1", 2, "--outlier-mm"),
    ("capture clean.npz ball.yaml --false-alarm 1", 2, "--false-alarm"),
    ("capture clean.npz ball.yaml ball.yaml", 2, "given twice"),
    ("capture clean.npz ball.yaml --reference absent.ply", 3, "absent.ply"),
    ("capture clean.npz ball.yaml --at x_m=1", 3, "start 1 m from"),
    ("capture noisy.npz ball.galvo.csv --rays 7", 2, "holds its rays already"),
]


@pytest.mark.parametrize(("line", "code", "message"), BAD)
def test_wrong_calls_end_in_one_clear_message(call, line, code, message):
    done = call(*line.split(), "--json")
    assert done.code == code
    assert message in json.dumps(json.loads(done.out))
    assert "Traceback" not in done.err
