"""The report is one page that works offline, and no name in it can become markup or script."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import plotly.graph_objects as go
import pytest
from jinja2 import UndefinedError
from support.references import shape_distance
from support.report_pages import (
    FRAMES,
    NASTY,
    PLACES,
    make_evaluation,
    make_report,
    make_row,
    make_scene,
    make_sensor,
    make_shown,
    ray_segments,
)

from lidardesign.evaluation.entries import StrongestBaseline
from lidardesign.evaluation.results import Evaluation, leading_detail, verdict
from lidardesign.report.figures import curve_figure, far_baselines, marginal_figure, plane_figure, series
from lidardesign.report.page import asset, report_html
from lidardesign.report.scene_figure import (
    FEWEST_STEPS,
    MOST_FACES,
    MOST_RAY_STEPS,
    MOST_STEPS,
    SceneFigure,
    drawn_share,
    frustum_lines,
    gate_shell,
    origin_lines,
    round_steps,
)
from lidardesign.report.sections import CommandTimes, constraints_section, scores_section, times_section
from lidardesign.report.view import MOST_BODIES, MOST_SENSORS, drawn_bodies, view_bounds, view_document, view_notes
from lidardesign.run.markup import rendered
from lidardesign.scenes.scene import Body, Box, Capsule, Cylinder, Ellipsoid, Mesh, Plane, Scene, Sphere, rigid
from lidardesign.scenes.triangulation import STEPS, body_triangles, thinned
from lidardesign.sensors.design import DesignSpec
from lidardesign.task import Metric


@pytest.fixture(scope="module")
def nasty():
    return report_html(make_report(NASTY))


@pytest.fixture(scope="module")
def plain():
    return report_html(make_report())


def parsed(text):
    """Tags with their attributes, as a browser would read them."""
    parser, tags = HTMLParser(), []
    parser.handle_starttag = lambda tag, attributes: tags.append((tag, dict(attributes)))
    parser.feed(text)
    return tags


def test_nothing_in_the_page_is_fetched_from_elsewhere(nasty):
    for tag, attributes in parsed(nasty):
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        assert "src" not in attributes
        assert attributes.get("href", "#").startswith("#")
    policies = [a["content"] for t, a in parsed(nasty) if t == "meta" and "http-equiv" in a]
    assert len(policies) == 1
    assert "default-src 'none'" in policies[0]
    assert not re.search(r"https?:|connect-src|\*", policies[0])
    style = asset("report.css")
    assert f"<style>{style}</style>" in nasty
    assert "url(" not in style
    assert "@import" not in style


def test_a_nasty_name_adds_no_tag_and_ends_no_script(nasty, plain):
    assert [tag for tag, _ in parsed(nasty)] == [tag for tag, _ in parsed(plain)]
    assert "<script>alert" not in nasty
    assert not any(key.startswith("on") for _, attributes in parsed(nasty) for key in attributes)


def test_the_page_repeats_byte_for_byte_and_every_link_has_its_place(plain):
    assert plain == report_html(make_report())
    tags = parsed(plain)
    identifiers = [attributes["id"] for _, attributes in tags if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    links = [attributes["href"][1:] for _, attributes in tags if "href" in attributes]
    assert len(links) > 8
    assert set(links) <= set(identifiers)
    figures = [attributes["data-figure"] for _, attributes in tags if "data-figure" in attributes]
    assert {"view-scene", "curve-rays", *figures} <= set(identifiers)


def test_a_value_that_a_template_misses_is_an_error():
    with pytest.raises(UndefinedError, match="caption"):
        rendered("api/templates/table.html", headings=(), rows=())


def test_every_switch_has_a_label_and_every_table_a_caption_and_scopes(plain):
    body = plain[plain.index("<body>") : plain.index("<script>")]
    boxes = body.count('type="checkbox"')
    assert boxes > 15
    assert boxes == len(re.findall(r'<label class="switch"><input type="checkbox"', body))
    for slider in re.findall(r'<input type="range" id="([^"]+)"', body):
        assert f'<label for="{slider}">' in body
    assert body.count("<table>") == body.count("<caption>") > 4
    assert not re.search(r"<th(?![^>]*scope)[ >]", body)


def test_what_is_not_there_has_no_section():
    bare = replace(make_report(), density=None, density_m=None, constraints={}, times=())
    places = {attributes["id"] for tag, attributes in parsed(report_html(bare)) if tag == "section"}
    assert {"density", "constraints", "time", "physics", "audit", "accuracy"}.isdisjoint(places)


def test_plotly_accepts_every_figure():
    report = make_report()
    looks = {curve.name: curve for curve in series(report.evaluation)}
    figures = [curve_figure(report.evaluation, against) for against in ("rays", "bandwidth")]
    figures += [marginal_figure(one, looks) for one in report.density.marginals]
    figures += [plane_figure(one) for one in report.density.planes]
    assert all(go.Figure(one).data for one in figures)


def test_one_number_of_rays_is_bars_and_shares_are_on_a_linear_axis():
    evaluation = make_report().evaluation
    one = replace(evaluation, rows=[row for row in evaluation.rows if row.rays == evaluation.rows[0].rays])
    bars = curve_figure(one, "rays")
    assert {trace["type"] for trace in bars["data"]} == {"bar"}
    assert bars["layout"]["yaxis"]["type"] == "linear"
    drawn = [(trace["x"][0], trace["y"][0]) for trace in bars["data"] if trace["x"]]
    assert drawn == [(curve.name, curve.rows[0].value) for curve in series(one)]
    assert len(bars["data"]) == 2 * len(drawn)  # a switch turns both of a curve
    assert go.Figure(bars).data
    wide = replace(evaluation, rows=[replace(row, value=row.value * 40**n) for n, row in enumerate(evaluation.rows)])
    for unit, kind in (("mm", "log"), ("%", "linear")):
        shown = replace(wide, metric=replace(wide.metric, unit=unit))
        assert curve_figure(shown, "rays")["layout"]["yaxis"]["type"] == kind


def test_a_baseline_that_was_asked_for_is_not_hidden():
    evaluation = replace(make_evaluation("plain"), named=("uniform",))
    assert far_baselines(evaluation) == set()
    assert "uniform" in {row.design for row in evaluation.baseline_rows}


def test_bars_of_constraints_are_full_at_the_bound_and_half_in_the_middle():
    report = make_report()
    (tight,) = report.constraints["plain"]
    full, half = replace(tight, room=0.0, share=0.0, tight=2), replace(tight, room=0.4, share=0.5, tight=0)
    text = constraints_section({"d": [full, half]})
    assert 'class="room full" role="img" aria-label="100 % used"' in text
    assert 'aria-label="50 % used"' in text
    assert "2 of 2" in text
    assert "no constraints" in constraints_section({"<d>": []})


def test_phases_add_up_and_small_ones_count_as_other():
    phases = {"learning": 60.0, "learning/target": 40.0, "tiny": 0.1, "writing": 39.0, "other": 0.9}
    one = CommandTimes("learn", "", phases)
    assert one.seconds == pytest.approx(100.0)
    text = times_section([one, CommandTimes("nothing", "", {})])
    shown = [float(value) for value in re.findall(r"</th><td>([0-9.]+)</td>", text)]
    assert shown == [60.0, 40.0, 39.0, 1.0]
    assert not re.search("tiny|nothing", text)


def luminance(colour):
    shares = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4 for value in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_text_is_dark_enough_on_its_ground():
    style = asset("report.css")
    named = dict(re.findall(r"--(\w+): (#[0-9a-f]{6});", style))
    colours = {named.get(name, name) for name in re.findall(r"[ {;]color: (?:var\(--)?([#\w]+)\)?;", style)}
    assert len(colours) >= 5
    grounds = ["#ffffff", named["tint"], "#fff8e6"]
    for colour in colours - {"inherit"}:
        for ground in grounds:
            assert (luminance(ground) + 0.05) / (luminance(colour) + 0.05) >= 4.5, (colour, ground)


def test_a_verdict_needs_an_interval_that_excludes_zero_and_the_metrics_direction():
    lower = make_evaluation("d")
    higher = Evaluation(Metric("share", "%", "higher", 0.0, 1.0), 1, lower.rows, lower.paired)
    assert [verdict(lower, pair) for pair in lower.paired] == ["better", "open"]
    assert [verdict(higher, pair) for pair in higher.paired] == ["worse", "open"]


@pytest.mark.parametrize(
    ("better", "strongest", "far"),
    [("lower", "close", {"awful"}), ("lower", "awful", set()), ("higher", "close", set())],
)
def test_baselines_are_hidden_at_first_where_they_are_far_worse_than_all_designs(better, strongest, far):
    rows = [make_row("d", 9, 10.0), make_row("close", 9, 14.0, True), make_row("awful", 9, 90.0, True)]
    # one that is far worse with few rays alone
    rows += [make_row("d", 25, 8.0), make_row("late", 9, 90.0, True), make_row("late", 25, 8.0, True)]
    rows += [make_row("awful", 25, 60.0, True)]
    metric = Metric("score", "mm", better, worst=200.0, tolerance=0.1)
    baseline = StrongestBaseline(strongest, 9, 20, {})
    assert far_baselines(Evaluation(metric, 1, rows, [], strongest_baseline=baseline)) == far


EGG = Ellipsoid((0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    "shape", [Sphere(0.4), Box((0.1, 0.2, 0.3)), Capsule(0.1, 0.3), Cylinder(0.1, 0.3), EGG, Plane()]
)
def test_drawn_primitives_have_their_vertices_on_the_surface(shape):
    bounds = np.array([[-1.0, -1, -1], [1, 1, 1]])
    vertices, faces = body_triangles(Body(shape), 0, bounds)
    assert (vertices.dtype, faces.dtype) == (np.float32, np.int32)
    assert faces.max() < len(vertices)
    # float32 vertices near 1
    assert np.abs(shape_distance(shape)(vertices.astype(float))).max() < 1e-6


def sheet(count, height=0.0):
    """Half of the cells of a grid over the unit square, waves of a height."""
    x, y = np.meshgrid(*[np.linspace(0, 1, count)] * 2)
    first = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    vertices = np.stack([x.ravel(), y.ravel(), height * np.sin(7 * x.ravel())], axis=1)
    return Mesh(vertices, np.stack([first, first + 1, first + count], axis=1), "unsigned")


def test_thinning_keeps_the_shape_and_respects_the_limit():
    mesh = sheet(120)
    small, kept = thinned(mesh.vertices, mesh.faces, most=2000)
    assert 200 < len(kept) <= 2000
    assert kept.max() < len(small)
    np.testing.assert_allclose(small.min(axis=0), 0.0, atol=0.05)
    np.testing.assert_allclose(small.max(axis=0)[:2], 1.0, atol=0.05)


def test_gates_are_drawn_as_shells_at_their_ranges():
    sensor = make_sensor(azimuth=1.0, elevation=1.5)
    vertices, _ = gate_shell(sensor)
    radii = np.linalg.norm(vertices, axis=1)
    # float32 coordinates of a few metres
    np.testing.assert_allclose(np.unique(np.round(radii, 5)), np.round(sensor.gate_m, 5), atol=2e-5)
    lines = frustum_lines(sensor)
    reach = np.linalg.norm(lines[~np.isnan(lines[:, 0])], axis=1)
    assert reach.max() == pytest.approx(sensor.gate_m[1], abs=1e-5)


def test_what_becomes_of_rays_is_known_at_every_position_and_frame():
    shown = make_shown()
    assert len(shown.frames) == FRAMES
    for one in shown.designs:
        assert one.outcome.shape == one.length_m.shape == (len(PLACES), FRAMES, 25)
        for place, rays in enumerate(one.rays):
            np.testing.assert_allclose(rays.origin_m[:, 1], PLACES[place]["y_m"])
            for step, frame in enumerate(shown.frames):
                expected = ray_segments(shown.scene, rays, frame)
                for code, lines in expected.items():
                    assert (one.outcome[place, step] == code).sum() == len(lines) // 3
                ends = np.concatenate([lines[1::3] for lines in expected.values()])
                order = np.lexsort(np.round(ends, 4).T), np.lexsort(np.round(one.ends_m[place, step], 4).T)
                np.testing.assert_allclose(ends[order[0]], one.ends_m[place, step][order[1]], atol=1e-4)


def test_long_scenes_and_many_rays_are_thinned_evenly_and_the_page_says_so():
    poses = np.stack([rigid(translation_m=(3, 0.01 * frame, 0)) for frame in range(200)])
    scene = Scene((Body(Sphere(0.4), "ball", "target", poses),), "long")
    places = [{"y_m": value} for value in np.linspace(-1, 1, 60)]
    shown = make_shown(designs=3, places=places, rays=600, scene=scene)
    assert (len(shown.places), shown.all_places) == (MOST_STEPS, 60)
    assert (shown.frames[0], shown.frames[-1]) == (0, 199)
    assert sum(one.outcome.size for one in shown.designs) <= MOST_RAY_STEPS
    text = " ".join(view_notes(shown))
    assert all(part in text for part in (f"{len(shown.frames)} of 200", "25 of 60", "of 600 rays of plain"))


def test_a_scan_of_hundreds_of_sensors_is_drawn_by_its_rays_alone():
    design = DesignSpec("scan", tuple(make_sensor(f"s{i}") for i in range(MOST_SENSORS + 1)))
    shown = make_shown(designs=1)
    one = replace(shown.designs[0], design=design, placed=(design,) * len(PLACES))
    document = view_document(replace(shown, designs=(one,)), series(make_evaluation("plain"))[:1])
    assert document["designs"][0]["sensors"] == 0
    assert document["designs"][0]["cones"] == ""


def test_everything_that_is_drawn_lies_in_the_box_unless_it_goes_far():
    shown = make_shown()
    low, high = view_bounds(shown)
    for one in shown.designs:
        ends = one.ends_m.reshape(-1, 3)
        assert (ends >= low - 1e-6).all()
        assert (ends <= high + 1e-6).all()
    from_afar = replace(shown.designs[0], length_m=np.full_like(shown.designs[0].length_m, 1e4))
    size = float(np.ptp(view_bounds(replace(shown, designs=(from_afar,))), axis=0).max())
    assert size < 3.5 * float(np.ptp(np.stack([low, high]), axis=0).max())


def test_very_many_bodies_are_drawn_coarser_and_the_largest_first():
    balls = tuple(Body(Sphere(0.1 + 0.001 * i), f"b{i}", "both") for i in range(MOST_BODIES + 10))
    scene = Scene(balls, "many")
    assert round_steps(scene) == FEWEST_STEPS < round_steps(make_scene()) == STEPS
    kept = drawn_bodies(SceneFigure(scene, (0,), ({},), ()))
    assert [body.name for body in kept] == [f"b{i}" for i in range(10, MOST_BODIES + 10)]
    floor = Body(Plane(), "floor", "both")
    assert drawn_bodies(SceneFigure(Scene((*balls, floor), "more"), (0,), ({},), ()))[-1] is floor


def test_a_page_of_twenty_designs_in_a_large_scene_stays_small():
    poses = np.stack([rigid(translation_m=(0, 0, frame)) for frame in range(40)])
    scene = Scene((Body(sheet(160, 1.0), "sheet", "both", poses),), "large")
    report = make_report(designs=20, scene=scene, rays=1000, places=[{"y_m": 0.1 * i} for i in range(30)])
    assert len(report_html(report)) < 8e6


def test_the_share_of_a_scene_that_is_drawn_bounds_all_its_meshes_together():
    mesh, poses = sheet(150, 1.0), np.stack([rigid(translation_m=(0, 0, frame)) for frame in range(3)])
    scene = Scene(tuple(Body(mesh, f"sheet {i}", poses=poses) for i in range(5)), "sheets")
    assert drawn_share(make_scene()) == 1.0
    assert drawn_share(scene) == pytest.approx(MOST_FACES / (5 * len(mesh.faces)))
    drawn = sum(len(body_triangles(body, 1, np.zeros((2, 3)), drawn_share(scene))[1]) for body in scene.bodies)
    assert 0.1 * MOST_FACES < drawn <= MOST_FACES + 5
    assert any("triangles of the meshes are drawn" in line for line in view_notes(make_shown(scene=scene)))


def test_where_rays_of_a_sensor_start_is_drawn_where_it_spreads():
    sensor = make_sensor()
    assert len(origin_lines(sensor, 0.95)) == 0
    turn = np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]])
    spread = turn @ np.diag([0.04, 0.01, 0]) @ turn.T
    flat = replace(sensor, origin_m=np.array([1.0, 2, 3]), origin_covariance_m2=spread)
    lines = origin_lines(flat, 0.95)
    local = (lines[~np.isnan(lines[:, 0])] - flat.origin_m) @ turn
    np.testing.assert_allclose(local[:, 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.hypot(local[:, 0] / 0.2, local[:, 1] / 0.1), 1.959964, atol=1e-4)
    thick = replace(flat, origin_covariance_m2=np.diag([0.04, 0.01, 0.02]))
    assert np.isnan(origin_lines(thick, 0.95)[:, 0]).sum() == 3


def test_the_tasks_first_further_figure_stands_beside_the_score():
    evaluation = make_evaluation("a")
    assert leading_detail(evaluation.rows) is None
    tracked = [replace(row, details={"tracked_share": 0.8125, "other": 3.0}) for row in evaluation.rows]
    assert leading_detail(tracked) == "tracked_share"
    assert "0.8125" in scores_section(replace(evaluation, rows=tracked))
