"""The report is one page that works offline, and no name in it can become markup or script."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from lidardesign.design.sensor import Design, Sensor
from lidardesign.evaluate.drawing import (
    MOST_FACES,
    body_triangles,
    drawn_share,
    frustum_lines,
    gate_shell,
    origin_lines,
    ray_segments,
    thinned,
)
from lidardesign.evaluate.figures import scene_figure
from lidardesign.evaluate.report import report_html, write_report
from lidardesign.evaluate.results import Evaluation, Paired, Row, leading_detail
from lidardesign.evaluate.verdicts import figure, rows_table, summary_sentences, verdict
from lidardesign.scene import Body, Box, Capsule, Mesh, Plane, Scene, Sphere, rigid
from lidardesign.simulate.returns import Outcome, Rays
from lidardesign.task import Metric

METRIC = Metric("Chamfer <distance>", "mm", "lower", worst=200.0, tolerance=0.1)
NASTY = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


def make_row(name, rays, value, baseline=False, matched_to=None):
    matched_rays = rays if matched_to else None
    values = np.array([value])
    return Row(name, rays, value, value, value, 0, 0.1, 0.5, values, baseline, matched_to, matched_rays)


def make_evaluation(name):
    rows = [make_row(name, 9, 10.0), make_row(name, 25, 5.0)]
    rows += [make_row("uniform", n, 20.0, baseline=True) for n in (9, 25)]
    paired = [Paired(name, "uniform", 9, -10.0, -12.0, -8.0), Paired(name, "uniform", 25, -15.0, -16.0, 1.0)]
    matched = [make_row("uniform", n, 30.0, True, name) for n in (9, 25)]
    bandwidth = [Paired(name, "uniform", n, -20.0, -25.0, -15.0, n) for n in (9, 25)]
    return Evaluation(METRIC, 1, rows, paired, matched, bandwidth, [f"note {name}"])


def make_sensor(name="s0", azimuth=0.0, elevation=0.0):
    return Sensor(name, 1.0, np.zeros(3), np.zeros((3, 3)), azimuth, elevation, 0.0, 0.1, 0.05, 2.7, 0.2)


def make_rays(count=9):
    spread = np.linspace(-0.5, 0.5, count)
    directions = np.stack([np.cos(spread), np.sin(spread), np.zeros(count)], axis=1)
    return Rays(
        np.zeros((count, 3)), directions, np.tile([2.0, 4.0], (count, 1)), np.zeros(count), np.zeros(count)
    )


def make_scene(name="ball"):
    post = Body(Box((0.02, 0.02, 0.5)), "post", "occluder", rigid(translation_m=(1.0, 0.1, 0.0)))
    floor = Body(Plane(), "floor", "both", rigid(translation_m=(0, 0, -1.0)))
    rod = Body(Capsule(0.1, 0.3), "rod", "target", rigid(translation_m=(3.0, 0.5, 0.0)))
    return Scene((Body(Sphere(0.4), name, "both", rigid(translation_m=(3, 0, 0))), post, floor, rod), name)


def make_report(name="plain", designs=1):
    made = [Design(name if i == 0 else f"{name} {i}", (make_sensor(name),)) for i in range(designs)]
    rays = {design.name: make_rays() for design in made}
    return report_html(make_evaluation(name), made, rays, make_scene(name), name, {"command": name})


class Collector(HTMLParser):
    """Tags with their attributes, as a browser would read them."""

    def __init__(self):
        super().__init__()
        self.tags = []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))


@pytest.fixture(scope="module")
def nasty():
    return make_report(NASTY, designs=2)


def parsed(text):
    collector = Collector()
    collector.feed(text)
    return collector.tags


def test_nothing_in_the_page_is_fetched_from_elsewhere(nasty):
    for tag, attributes in parsed(nasty):
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        assert "src" not in attributes
        assert "href" not in attributes
    policies = [a["content"] for t, a in parsed(nasty) if t == "meta" and "http-equiv" in a]
    assert len(policies) == 1
    assert "default-src 'none'" in policies[0]
    assert not re.search(r"https?:|connect-src|\*", policies[0])
    style = nasty[nasty.index("<style>") : nasty.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style


def test_a_nasty_name_adds_no_tag_and_ends_no_script(nasty):
    harmless = [tag for tag, _ in parsed(make_report("plain", designs=2))]
    assert [tag for tag, _ in parsed(nasty)] == harmless
    assert "<script>alert" not in nasty
    assert not any(key.startswith("on") for _, attributes in parsed(nasty) for key in attributes)


def test_the_page_repeats_byte_for_byte_and_has_fixed_places():
    first = make_report()
    assert first == make_report()
    identifiers = [attributes["id"] for _, attributes in parsed(first) if "id" in attributes]
    for place in ("view-scene", "curve-rays", "curve-bandwidth"):
        assert identifiers.count(place) == 1


def test_the_page_holds_tables_verdicts_and_how_to_reproduce(tmp_path):
    design = Design("mine", (make_sensor(),))
    write_report(
        make_evaluation("mine"),
        [design],
        {"mine": make_rays()},
        make_scene(),
        tmp_path / "report.html",
        reproduce={"command": "lidardesign evaluate run", "seed": 7},
    )
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    for expected in ("lidardesign evaluate run", "note mine", 'class="better"', "not clear", "viewport"):
        assert expected in text


def test_a_verdict_needs_an_interval_that_excludes_zero_and_the_metrics_direction():
    lower = make_evaluation("d")
    higher = Evaluation(Metric("share", "%", "higher", 0.0, 1.0), 1, lower.rows, lower.paired)
    assert [verdict(lower, pair) for pair in lower.paired] == ["better", "open"]
    assert [verdict(higher, pair) for pair in higher.paired] == ["worse", "open"]
    assert "no clear difference from uniform" in summary_sentences(lower)[1]


def test_figures_have_four_digits():
    assert [figure(v) for v in (0.1152, 39.1, 1234.0, 0.0)] == ["0.1152", "39.10", "1234", "0.000"]


@pytest.mark.parametrize(
    ("shape", "distance"),
    [
        (Sphere(0.4), lambda p: np.linalg.norm(p, axis=1) - 0.4),
        (Box((0.1, 0.2, 0.3)), lambda p: np.max(np.abs(p) - [0.1, 0.2, 0.3], axis=1)),
        (
            Capsule(0.1, 0.3),
            lambda p: np.linalg.norm(p - np.clip(p, [0, 0, -0.3], [0, 0, 0.3]), axis=1) - 0.1,
        ),
        (Plane(), lambda p: p[:, 2]),
    ],
)
def test_drawn_primitives_have_their_vertices_on_the_surface(shape, distance):
    bounds = np.array([[-1.0, -1, -1], [1, 1, 1]])
    vertices, faces = body_triangles(Body(shape), 0, bounds)
    assert vertices.dtype == np.float32
    assert faces.dtype == np.int32
    assert faces.max() < len(vertices)
    # float32 vertices near 1
    assert np.abs(distance(vertices.astype(float))).max() < 1e-6


def test_thinning_keeps_the_shape_and_respects_the_limit():
    side = np.linspace(0, 1, 120)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    first = (np.arange(119)[:, None] * 120 + np.arange(119)).ravel()
    faces = np.stack([first, first + 1, first + 120], axis=1)
    mesh = Mesh(vertices, faces, "unsigned")
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


def test_rays_are_drawn_to_the_first_hit_or_the_end_of_the_gate():
    segments = ray_segments(make_scene(), make_rays(101))
    assert sum(len(lines) // 3 for lines in segments.values()) == 101
    ends = {outcome: np.linalg.norm(lines[1::3], axis=1) for outcome, lines in segments.items()}
    assert (ends[Outcome.OCCLUDED] < 2.0).all()
    assert len(ends[Outcome.OCCLUDED]) > 0
    assert ((ends[Outcome.RETURN] >= 2.0) & (ends[Outcome.RETURN] < 4.0)).all()
    np.testing.assert_allclose(ends[Outcome.MISS], 4.0, atol=1e-5)


def test_one_design_is_shown_at_a_time_and_the_scene_always():
    designs = [Design(name, (make_sensor(),)) for name in ("a", "b")]
    figure, masks = scene_figure(make_scene(), designs, {name: make_rays() for name in ("a", "b")})
    assert len(masks["a"]) == len(figure["data"])
    both = np.array(masks["a"]) & np.array(masks["b"])
    assert [trace["name"] for trace, shown in zip(figure["data"], both, strict=True) if shown] == [
        "scene",
        "occluders",
    ]
    assert (np.array(masks["a"]) | np.array(masks["b"])).all()


def test_a_scan_of_hundreds_of_sensors_is_drawn_by_its_rays_alone():
    design = Design("scan", tuple(make_sensor(f"s{i}") for i in range(300)), layout="scan")
    figure, _ = scene_figure(make_scene(), [design], {"scan": make_rays(300)})
    assert len(figure["data"]) < 12


def test_the_share_of_a_scene_that_is_drawn_bounds_all_its_meshes_together():
    side = np.linspace(0, 1, 150)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x.ravel(), y.ravel(), np.sin(7 * x.ravel())], axis=1)
    first = (np.arange(149)[:, None] * 150 + np.arange(149)).ravel()
    sheet = Mesh(vertices, np.stack([first, first + 1, first + 150], axis=1), "unsigned")
    poses = np.stack([rigid(translation_m=(0, 0, frame)) for frame in range(3)])
    scene = Scene(tuple(Body(sheet, f"sheet {i}", poses=poses) for i in range(5)), "sheets")
    assert drawn_share(make_scene()) == 1.0
    assert drawn_share(scene) == pytest.approx(MOST_FACES / (5 * len(sheet.faces)))
    drawn = sum(len(body_triangles(body, 1, np.zeros((2, 3)), drawn_share(scene))[1]) for body in scene.bodies)
    assert 0.1 * MOST_FACES < drawn <= MOST_FACES + 5
    design = Design("a", (make_sensor(),))
    text = report_html(make_evaluation("a"), [design], {"a": make_rays()}, scene, at={"x_m": 0.37})
    assert "frame 2 of 3, seen from x_m=0.37 (drawn coarser" in text
    assert len(text) < 8e6


def test_a_moving_scene_is_drawn_at_the_frame_in_the_middle():
    poses = np.stack([rigid(translation_m=(3, y, 0)) for y in (9.0, 0.0, 9.0)])
    scene = Scene((Body(Sphere(0.4), "ball", "target", poses),), "moving")
    text = report_html(make_evaluation("a"), [Design("a", (make_sensor(),))], {"a": make_rays(101)}, scene)
    # the ball is only in front of the rays in the middle frame
    hits = len(ray_segments(scene, make_rays(101), 1)[Outcome.RETURN]) // 3
    assert hits > 20
    assert f"return ({hits})" in text


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
    text = rows_table(replace(evaluation, rows=tracked))
    assert "tracked share" in text
    assert "0.8125" in text
    assert "other" not in text
    assert "tracked" not in rows_table(evaluation)
