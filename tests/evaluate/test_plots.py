"""Pictures for papers and rows as CSV: readable without colour, honest about units, whatever the names are."""

import csv
import io
import math
import re
import subprocess
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from support.evaluations import METRIC, make_evaluation
from support.tables import each_row

from lidardesign.design.constraints.slack import ConstraintSlack
from lidardesign.design.sensor import DesignSpec, Sensor
from lidardesign.evaluate.effects import EffectSummary
from lidardesign.evaluate.report.series import (
    COLOURS,
    COLUMN_INCHES,
    DOTS_PER_INCH,
    LOOK,
    PAGE_INCHES,
    SMALL_POINTS,
    axis_titles,
    log_ticks,
    logarithmic,
    picture,
    picture_style,
    plain_label,
    series,
    write_pictures,
)
from lidardesign.evaluate.report.density_views import density_view
from lidardesign.evaluate.figures.plots import pictures, write_plots
from lidardesign.evaluate.figures.scene import OUTCOME_LOOKS, framed_points, opened, scene_picture, shaded, view_of
from lidardesign.evaluate.report.scene_figure import FigureData, constraint_slack_of, scene_figure
from lidardesign.evaluate.figures.scores import MOST_ROWS, constraints_picture, curve_picture, drawn_pairs, phase_rows
from lidardesign.evaluate.results import Evaluation, Paired, csv_text, write_csv
from lidardesign.geometry.rays import Outcome, Rays
from lidardesign.samples import Samples
from lidardesign.scene import Body, Box, Plane, Receiver, Scene, Sphere, rigid
from lidardesign.simulate.plan import Tolerance
from lidardesign.space import DesignSpace

NASTY = "</text><script>alert(1)</script> & $x^2$ \"'"
BALL = Scene(
    (
        Body(Sphere(0.4), NASTY, "both", rigid(translation_m=(3.0, 0.0, 0.0))),
        Body(Sphere(0.1), "post", "occluder", rigid(translation_m=(1.5, 0.2, 0.0))),
        Body(Plane(), "floor", "both", rigid(translation_m=(0.0, 0.0, -1.0))),
    ),
    NASTY,
)
SPACE = DesignSpace((0, 0, 0, -0.3, -0.3, 1.0), (0, 0, 0, 0.3, 0.3, 5.0))


def make_sensor(name="s0"):
    return Sensor(name, 1.0, np.zeros(3), np.zeros((3, 3)), 0.0, 0.0, 0.0, 0.1, 0.05, 3.0, 0.2)


def make_rays(count=25):
    across, up = np.meshgrid(np.linspace(-0.2, 0.2, 5), np.linspace(-0.2, 0.2, count // 5))
    azimuth, elevation = across.ravel(), up.ravel()
    ahead = np.cos(elevation)
    directions = np.stack([ahead * np.cos(azimuth), ahead * np.sin(azimuth), np.sin(elevation)], axis=1)
    zeros = np.zeros(count)
    return Rays(np.zeros((count, 3)), directions, np.tile([2.0, 4.0], (count, 1)), zeros, zeros)


def make_shown(names=("first",)):
    designs = [DesignSpec(name, (make_sensor(),)) for name in names]
    return scene_figure(BALL, designs, [{}], lambda design, at: make_rays())


def make_pictured(names=("first",)):
    samples = Samples(SPACE.sample(2000, np.random.default_rng(0)), np.zeros(2000), np.zeros(2000), SPACE)
    view = density_view(samples, BALL, [DesignSpec(name, (make_sensor(),)) for name in names])
    bounds = [
        ConstraintSlack("gate.width_m.max", 0.5, 0.5, "s0", 0.0, 0.0, 1, 1, 0),
        ConstraintSlack("origin.fixed_m", [0, 0, 0], [0, 0, 0], "", None, None, 1, 0, 0),
        ConstraintSlack(f"field of view {NASTY}", 20.0, 30.0, "s0", -10.0, -0.5, 1, 0, 1),
    ]
    times = {"learn": {"scenes": 1.0, "learning": 9.0, "learning/target": 5.0, "other": 0.5}}
    return FigureData(make_shown(names), view, dict.fromkeys(names, bounds), times)


def make_effect(name, range_m, scenes_on):
    return EffectSummary(name, scenes_on, range_m, 0.0, Tolerance(0.001, 0.01), "a reason", 0.1)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """All pictures but those of accuracy, of a design, a scene and bounds with nasty names."""
    effects = [make_effect("footprint", 0.01, 1.0), make_effect("motion", 0.0001, 0.0), make_effect("fog", 0.0, 0.0)]
    evaluation = replace(make_evaluation((NASTY, "second")), effects=effects)
    return write_plots(evaluation, tmp_path_factory.mktemp("plots") / "new folder", make_pictured((NASTY, "second")))


def test_everything_of_the_report_is_written_as_png_and_svg(written):
    stems = ["scene", "density_marginals", "density_field", "score_against_rays", "score_against_bandwidth"]
    stems += ["paired_differences", "constraints", "effects", "times"]
    assert [path.name for path in written] == [f"{stem}.{kind}" for stem in stems for kind in ("png", "svg")]
    assert sorted(path.name for path in written[0].parent.iterdir()) == sorted(path.name for path in written)


def test_pictures_are_a_column_or_a_page_wide_with_letters_to_read(written):
    for path in written[::2]:
        with Image.open(path) as image:
            width = image.width
        assert width in (round(COLUMN_INCHES * DOTS_PER_INCH), round(PAGE_INCHES * DOTS_PER_INCH))
    for path in written[1::2]:
        found = re.findall(r"font(?:-size)?: ([0-9.]+)px", path.read_text(encoding="utf-8"))
        sizes = {float(size) for size in found}
        assert sizes
        # a point is a pixel of the SVG's own units
        assert min(sizes) >= SMALL_POINTS


def test_no_name_becomes_markup_and_no_picture_reaches_out(written):
    for path in written[1::2]:
        text = path.read_text(encoding="utf-8")
        assert "<script" not in text
        tree = ElementTree.fromstring(text)
        assert not [node for node in tree.iter() if node.tag.endswith("}script")]
        links = [value for node in tree.iter() for name, value in node.attrib.items() if name.endswith("href")]
        assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)
        assert "url(http" not in text


def test_names_stand_in_the_pictures_as_they_are(written):
    tree = ElementTree.fromstring(next(path for path in written if path.name == "density_marginals.svg").read_text())
    words = ["".join(node.itertext()) for node in tree.iter() if node.tag.endswith("}text")]
    assert plain_label(NASTY) in words
    assert "azimuth [deg]" in words


def test_the_same_evaluation_gives_the_same_bytes(written, tmp_path):
    names = (NASTY, "second")
    drawing = pictures(make_evaluation(names), make_pictured(names))
    for stem in ("score_against_rays", "density_field"):
        with picture_style():
            again = write_pictures(drawing[stem](), tmp_path, stem)
        for path in again:
            assert path.read_bytes() == (written[0].parent / path.name).read_bytes()
            assert b"<dc:date>" not in path.read_bytes()


def test_settings_of_the_user_neither_change_pictures_nor_are_changed():
    import matplotlib

    plain = drawn(make_evaluation())
    own = {"font.size": 30.0, "axes.facecolor": "red", "text.usetex": False, "svg.fonttype": "path"}
    with matplotlib.rc_context(own):
        before = dict(matplotlib.rcParams)
        assert drawn(make_evaluation()) == plain
        assert dict(matplotlib.rcParams) == before
    assert LOOK["svg.fonttype"] == "none"


def drawn(evaluation, against="rays"):
    with picture_style():
        return picture(curve_picture(evaluation, against), "svg")


def test_any_name_can_be_drawn():
    names = ("$x$ and $", "_hidden", "设计", "a" * 300, "<b>", "\\frac", "two\nlines\0")
    tree = ElementTree.fromstring(drawn(make_evaluation(names), against="bandwidth"))
    words = ["".join(node.itertext()).strip() for node in tree.iter() if node.tag.endswith("}text")]
    assert {"$x$ and $", "_hidden", "设计", f"{'a' * 27}…", "<b>", "\\frac", "two lines"} <= set(words)


@each_row("value", [0.0, -3.0, 1e-9, 1e9])
def test_any_finite_score_can_be_drawn(value):
    assert drawn(make_evaluation(("one",), value=value, rays=(8,) if value == 0.0 else (8, 64)))


def test_what_there_is_nothing_to_draw_for_is_no_picture():
    evaluation = Evaluation(METRIC, 5, make_evaluation().rows, [])
    with picture_style():
        empty = [stem for stem, draw in pictures(evaluation, FigureData()).items() if draw() is None]
    stems = "scene density_marginals density_field paired_differences constraints effects accuracy times"
    assert empty == stems.split()


def test_outcomes_differ_in_more_than_colour():
    assert set(OUTCOME_LOOKS) == set(Outcome)
    assert len({str(dash) for _, dash, _ in OUTCOME_LOOKS.values()}) == len(Outcome)
    assert len({colour for colour, _, _ in OUTCOME_LOOKS.values()}) == len(Outcome)


def test_everything_that_matters_is_inside_the_picture():
    shown = make_shown()
    points = framed_points(shown, 0, 0)
    view = view_of(shown.directions, points)
    left, right, bottom, top = view.window
    across, up = view.project(np.concatenate([shown.designs[0].rays[0].origin_m, points])).T
    assert left < across.min() <= across.max() < right
    assert bottom < up.min() <= up.max() < top
    assert view.depth(points).min() > view.near_m


def test_the_camera_sees_a_ball_as_large_as_it_is_and_what_hides_behind_it():
    view = view_of(np.array([[1.0, 0.0, 0.0]]), np.array([[2.0, -1.0, -1.0], [4.0, 1.0, 1.0]]))
    ball = Scene((Body(Sphere(0.4), "ball", "target", rigid(translation_m=(3.0, 0.0, 0.0))),), "ball")
    image = shaded(ball, 0, view, 300)
    left, right, _, _ = view.window
    area = (image.colour[..., 3] > 0).sum() * ((right - left) / 300) ** 2
    assert area == pytest.approx(math.pi * 0.16, rel=0.02)
    behind = np.array([3.0, 0.0, 0.0]) + np.array([[1.0], [-1.0]]) * view.forward
    assert image.hides(view, behind, 0.01).tolist() == [True, False]


def test_planes_are_seen_from_their_front_only():
    ceiling = Body(Plane(), "ceiling", "both", rigid(np.diag([1.0, -1.0, -1.0]), (0.0, 0.0, 1.0)))
    view = view_of(np.array([[1.0, 0.0, 0.0]]), np.array([[2.0, -1.0, -0.5], [4.0, 1.0, 0.5]]))
    alone = shaded(Scene((BALL.bodies[0],), "ball"), 0, view, 60)
    assert np.array_equal(shaded(Scene((BALL.bodies[0], ceiling), "ball"), 0, view, 60).depth_m, alone.depth_m)
    floor = shaded(Scene((BALL.bodies[0], BALL.bodies[2]), "ball"), 0, view, 60)
    assert np.isfinite(floor.depth_m).all()


def test_a_room_is_cut_open_where_its_walls_hide_the_sensors():
    room = Scene((Body(Box((6.0, 6.0, 6.0)), "room", "both"),), "room")
    design = DesignSpec("inside", (make_sensor(),))
    shown = scene_figure(room, [design], [{}], lambda design, at: make_rays())
    view = view_of(shown.directions, framed_points(shown, 0, 0))
    image, cut = opened(shown, 0, 0, view, 60)
    assert cut
    assert not image.hides(view, np.zeros((1, 3)), 0.05).any()
    assert not opened(make_shown(), 0, 0, view, 60)[1]


def test_a_detector_of_its_own_has_a_mark(written):
    scene = replace(BALL, receiver=Receiver((0.0, 0.5, 0.0), 0.0, 0.0, 0.5, 0.5, (0.1, 9.0)))
    shown = replace(make_shown(("first", "second")), scene=scene)
    left, right, bottom, top = (view := view_of(shown.directions, framed_points(shown, 0, 0))).window
    across, up = view.project(np.array([0.0, 0.5, 0.0]))
    assert left < across < right
    assert bottom < up < top
    with picture_style():
        names = [text.get_text() for text in scene_picture(shown).legends[0].get_texts()]
        assert "detector" in names
    assert ">detector<" not in written[1].read_text(encoding="utf-8")


def test_a_flat_world_is_seen_from_above():
    view = view_of(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0.0, 0.0, 0.0], [2.0, 1.0, 0.0]]))
    assert view.project(np.array([2.0, 1.0, 5.0])) == pytest.approx([2.0, 1.0])


def test_many_differences_are_thinned_and_the_picture_says_so():
    few, told = drawn_pairs(make_evaluation())
    assert len(few) == 3
    assert "most rays" not in told
    names = tuple(f"d{i}" for i in range(30))
    evaluation = make_evaluation(names)
    pairs = [
        Paired(name, other, n, -1.0, -2.0, 0.5) for name in names for other in ("uniform", "d0") for n in (36, 576)
    ]
    many, told = drawn_pairs(Evaluation(METRIC, 5, evaluation.rows, pairs))
    assert len(many) <= MOST_ROWS
    assert {pair.rays for pair in many} == {576}
    assert {pair.b for pair in many} == {"uniform"}
    assert "against rivals" in told


def test_phases_add_up_to_the_time_of_the_command():
    timings = {"scenes": 1.0, "learning": 9.0, "learning/target": 5.0, "tiny": 0.001, "other": 0.5}
    rows = phase_rows(timings)
    assert math.fsum(seconds for _, seconds, inside in rows if not inside) == pytest.approx(10.501)
    assert [name for name, _, _ in rows] == ["scenes", "learning", "target", "other"]
    assert phase_rows({}) == []


def test_a_design_without_constraints_has_no_bounds_to_draw():
    free = constraint_slack_of(DesignSpec("free", (make_sensor(),)), SPACE)
    assert {one.name.split(".")[0] for one in free} == {"space"}
    assert constraints_picture({"free": free}) is None
    bound = DesignSpec("bound", (make_sensor(),), constraints={"gate": {"width_m": {"max": 1.0}}})
    (row,) = [one for one in constraint_slack_of(bound, SPACE) if one.name == "gate.width_m.max"]
    assert row.room == pytest.approx(1.0 - 2 * 1.959964 * 0.2, abs=1e-5)


def test_series_differ_in_more_than_colour():
    curves = series(make_evaluation(tuple(f"design {i}" for i in range(2 * len(COLOURS)))))
    looks = [(curve.marker, curve.dash) for curve in curves]
    assert len(set(looks)) == len(looks)
    assert [curve.baseline for curve in curves[-2:]] == [True, True]


def test_axes_name_their_units_and_direction():
    titles = ("bandwidth [Mbit/s]", "Chamfer distance [mm], lower is better")
    assert axis_titles(make_evaluation(), "bandwidth") == titles


def test_logarithmic_axes_need_positive_values_over_a_wide_span():
    assert logarithmic([1.0, 10.0])
    assert not logarithmic([1.0, 2.0])
    assert not logarithmic([0.0, 10.0])
    assert not logarithmic([])


def test_the_table_holds_every_row_with_units_in_its_header(tmp_path):
    evaluation = make_evaluation(("with, comma", "=cmd()"))
    write_csv(evaluation, tmp_path / "rows.csv")
    text = (tmp_path / "rows.csv").read_text(encoding="utf-8")
    assert text == csv_text(evaluation)
    header, *lines = csv.reader(io.StringIO(text))
    assert "Chamfer distance [mm]" in header
    assert "bandwidth [Mbit/s]" in header
    assert len(lines) == len(evaluation.rows) + len(evaluation.equal_bandwidth)
    assert lines[0][0] == "with, comma"
    assert float(lines[0][2]) == evaluation.rows[0].value
    assert lines[3][0] == "'=cmd()"
    assert lines[-1][header.index("matched_to")] == "with, comma"


def test_nothing_draws_before_it_is_asked_to():
    code = (
        "import sys, lidardesign.evaluate.figures.plots, lidardesign.evaluate.report.report\n"
        "import lidardesign.evaluate.score\n"
        "print([m for m in ('matplotlib', 'plotly', 'torch', 'scipy.stats') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@each_row("span", [4.1, 20.0, 29.0, 31.0, 1e5])
@each_row("low", [0.037, 1.0, 5.7])
def test_a_logarithmic_axis_has_at_least_three_labels_at_round_places_inside_it(low, span):
    ticks = log_ticks([low * span, low])
    assert ticks == sorted(set(ticks))
    assert 3 <= len(ticks) <= 18
    assert low / 1.21 <= ticks[0] < ticks[-1] <= low * span * 1.21
    assert all(f"{tick:.1e}"[:3] in ("1.0", "1.5", "2.0", "3.0", "4.0", "5.0", "6.0", "8.0") for tick in ticks)
