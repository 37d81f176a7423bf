"""The report in a real browser: it asks nobody for anything, complains of nothing, draws, and answers its switches.

One browser and one page for all tests; where there is no browser they are skipped.
"""

from __future__ import annotations

import io
from xml.etree import ElementTree

import numpy as np
import pytest
from support.browsers import opened_browser
from support.report_pages import FRAMES, NASTY, PLACES, make_report

from lidardesign.report.page import report_html
from lidardesign.report.scene_figure import frustum_lines, origin_lines
from lidardesign.scenes.rays import Outcome
from lidardesign.scenes.triangulation import body_triangles, scene_bounds

WAIT_MS = 120_000  # software that draws in 3D on a busy machine takes its time
DRAWN = "html[data-drawn]"
GREEN = (0, 158, 115)  # of rays that return


@pytest.fixture(scope="module")
def report():
    return make_report(NASTY)


@pytest.fixture(scope="module")
def opened(report, tmp_path_factory):
    """The page, drawn, with what it said and asked for from the very beginning."""
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(report_html(report), encoding="utf-8")
    heard = {"errors": [], "requests": [], "dialogs": []}
    with opened_browser() as browser:
        # smooth scrolling would move what the pointer is about to press
        page = browser.new_page(viewport={"width": 480, "height": 360}, reduced_motion="reduce")
        page.set_default_timeout(WAIT_MS)
        page.on("console", lambda message: heard["errors"].append(message.text))
        page.on("pageerror", lambda error: heard["errors"].append(str(error)))
        page.on("dialog", lambda dialog: (heard["dialogs"].append(dialog.message), dialog.dismiss()))
        page.on("request", lambda request: heard["requests"].append(request.url))
        page.goto(path.as_uri(), wait_until="commit")
        page.wait_for_selector(DRAWN, state="attached", timeout=WAIT_MS)
        yield page, heard, path


@pytest.fixture
def page(opened):
    return opened[0]


def picture(page):
    """What the 3D view shows, as an array of colours, shape (H, W, 3)."""
    from PIL import Image

    settle(page)
    shot = page.locator("#view-scene").screenshot(timeout=WAIT_MS)
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), dtype=int)


def settle(page):
    """Wait until what was asked for last is drawn."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))")


def close_to(shown, colour, within=40):
    return int((np.abs(shown - np.array(colour)).max(axis=2) < within).sum())


def counts(page):
    settle(page)
    script = "() => Object.fromEntries([...counts].map(([code, count]) => [code, count]))"
    return {int(code): count for code, count in page.evaluate(script).items()}


def expected_counts(report, place, frame, hidden=()):
    one = report.shown.designs[0]
    kept = ~np.isin(one.rays[place].sensor, hidden)
    return {int(code): int((one.outcome[place, frame][kept] == code).sum()) for code in Outcome}


def restored(page):
    page.evaluate("""() => {
      for (const box of all('input[type=checkbox]')) box.checked = box.defaultChecked;
      for (const slider of all('input[type=range]')) slider.value = slider.defaultValue;
      return drawScene();
    }""")


def assert_quiet(opened):
    _, heard, path = opened
    assert heard["errors"] == heard["dialogs"] == []
    assert [url for url in heard["requests"] if not url.startswith(("data:", "blob:"))] == [path.as_uri()]


def test_the_page_asks_nobody_and_complains_of_nothing(opened):
    assert_quiet(opened)
    assert opened[0].title() == NASTY


def test_the_view_draws_and_its_switches_change_what_is_drawn(page, report):
    restored(page)
    first = picture(page)
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 100
    assert close_to(first, GREEN) > 20
    page.locator(f"[data-outcome='{int(Outcome.RETURN)}']").uncheck()
    assert close_to(picture(page), GREEN) < 0.2 * close_to(first, GREEN)
    page.locator("[data-layer='scene']").uncheck()
    without = picture(page)
    assert (np.abs(without - first).max(axis=2) > 20).sum() > 500
    for layer in ("occluders", "fields", "gates", "starts"):
        page.locator(f"[data-layer='{layer}']").uncheck()
    page.locator("[data-design='0']").uncheck()
    empty = picture(page)
    page.locator("[data-layer='density']").check()
    assert (np.abs(picture(page) - empty).max(axis=2) > 20).sum() > 100


def test_switching_a_sensor_off_takes_its_rays_away(page, report):
    restored(page)
    place, frame = len(PLACES) // 2, FRAMES // 2
    assert counts(page) == expected_counts(report, place, frame)
    page.locator("[data-sensor='0.1']").uncheck()
    assert counts(page) == expected_counts(report, place, frame, hidden=[1])
    page.locator("[data-every='0'][data-to='off']").click()
    assert sum(counts(page).values()) == 0
    page.locator("[data-every='0'][data-to='on']").click()
    page.locator("[data-design='1']").check()
    both = {code: 2 * count for code, count in expected_counts(report, place, frame).items()}
    assert counts(page) == both


def test_sliders_go_through_positions_and_frames(page, report):
    restored(page)
    slider = page.locator("#view-place")
    slider.focus()
    slider.press("Home")
    page.locator("#view-frame").focus()
    page.locator("#view-frame").press("End")
    assert counts(page) == expected_counts(report, 0, FRAMES - 1)
    status = page.locator("#view-status").inner_text()
    assert status.startswith(f"y_m = -0.3; frame {FRAMES} of {FRAMES}, 0.30 s;")
    assert slider.get_attribute("aria-valuetext") == "y_m = -0.3"
    page.locator("#view-frame").press("ArrowLeft")
    assert counts(page) == expected_counts(report, 0, FRAMES - 2)


def path_script(call):
    return f"""() => {{
      const path = new Path();
      {call};
      return ['x', 'y', 'z'].map(name => path[name].map(value => Number.isNaN(value) ? null : value));
    }}"""


def test_the_page_draws_the_same_frusta_and_origins_as_the_program(page, report):
    shown = report.shown.designs[0]
    sensor = shown.placed[2].sensors[1]
    drawn = np.array(page.evaluate(path_script("frustumLines(coneOf(view.designs[0], 2, 1), path)")), dtype=float).T
    np.testing.assert_allclose(drawn, frustum_lines(sensor), atol=1e-5)
    page.evaluate("() => { view.designs[0].cones.set([0.5, 0, 0, 0, 0.2, 0, 0, 0, 0], 16); }")
    starts = np.array(page.evaluate(path_script("originLines(coneOf(view.designs[0], 0, 0), path)")), dtype=float).T
    page.evaluate("() => { view.designs[0].cones.fill(0, 16, 25); }")
    assert len(starts) == 26  # one ellipse where an origin has no thickness
    assert np.nanmax(np.abs(starts[:, 0] - shown.placed[0].sensors[0].origin_m[0])) == pytest.approx(0.5)
    assert len(origin_lines(sensor, 0.95)) == 0


@pytest.mark.parametrize("target", [True, False])
def test_bodies_are_drawn_where_they_are_at_each_frame(page, report, target):
    scene = report.shown.scene
    script = """([target, frame]) => {
      const columns = bodyColumns(view, target, frame);
      return [...'xyzijk'].map(name => [...columns[name]]);
    }"""
    for step, frame in enumerate(report.shown.frames):
        columns = page.evaluate(script, [target, step])
        corners = np.array(columns[:3]).T[np.array(columns[3:]).T].reshape(-1, 9)
        bounds = np.array(page.evaluate("view.bounds"))
        pieces = [body_triangles(body, frame, bounds) for body in scene.bodies if body.is_target == target]
        expected = np.concatenate([vertices[faces].reshape(-1, 9) for vertices, faces in pieces])
        assert corners.shape == expected.shape
        ours, theirs = (each[np.lexsort(np.round(each, 3).T)] for each in (corners, expected))
        np.testing.assert_allclose(ours.mean(axis=0), theirs.mean(axis=0), atol=1e-5)
        np.testing.assert_allclose(np.sort(ours, axis=0), np.sort(theirs, axis=0), atol=1e-5)
        assert np.all(scene_bounds(scene, frame, [])[0] >= bounds[0] - 1e-6)


def camera_of(page):
    settle(page)
    return page.evaluate("() => camera")


def test_the_camera_turns_by_buttons_keys_and_the_pointer(page):
    restored(page)
    page.locator("[data-camera='reset']").click()
    first = camera_of(page)
    page.locator("[data-camera='left']").click()
    assert camera_of(page)["turn"] == pytest.approx(first["turn"] - np.pi / 12)
    page.locator("#view-scene").focus()
    page.keyboard.press("ArrowRight")
    assert camera_of(page)["turn"] == pytest.approx(first["turn"])
    page.keyboard.press("+")
    assert camera_of(page)["zoom"] == pytest.approx(1.2)
    page.keyboard.press("Home")
    page.locator("#view-scene").hover(position={"x": 100, "y": 100})
    box = page.locator("#view-scene").bounding_box()
    page.mouse.down()
    page.mouse.move(box["x"] + 150, box["y"] + 110)
    page.mouse.up()
    turned = camera_of(page)
    assert turned["turn"] < first["turn"]
    assert turned["height"] > first["height"]
    page.locator("[data-design='1']").check()
    assert camera_of(page) == turned


def test_a_world_in_a_plane_turns_and_moves_like_a_map(page):
    page.evaluate(
        "() => { view.camera.flat = true; Object.assign(camera, {turn: -Math.PI / 2, height: Math.PI / 2}); }"
    )
    before = camera_of(page)
    for how in ("right", "up", "closer"):
        page.evaluate(f"() => moveCamera('{how}')")
    assert camera_of(page)["height"] == before["height"]
    page.evaluate("() => { Object.assign(camera, {turn: -Math.PI / 2}); slideCamera(10, 10); }")
    (x, y, _), (x0, y0, _) = camera_of(page)["center"], before["center"]
    assert x < x0
    assert y > y0
    page.evaluate("() => { view.camera.flat = false; moveCamera('reset'); }")


def test_the_first_view_holds_the_whole_box_and_projects_as_a_camera_does(page):
    restored(page)
    page.evaluate("() => moveCamera('reset')")
    settle(page)
    size, found = page.evaluate("""() => {
      const box = find('#view-scene').getBoundingClientRect();
      const lens = lensOf(camera, box.width, box.height);
      return [[box.width, box.height], corners(view.bounds).map(point => [...point, ...lens.seen(...point)])];
    }""")
    (points, seen), look = np.split(np.array(found), 2, axis=1), page.evaluate("() => camera")
    assert (seen[:, :2] > 40).all()
    assert (seen[:, :2] < np.array(size) - 40).all()
    # straight lines through one eye, by a plain float64 twin
    turn, height = look["turn"], look["height"]
    back = np.array([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)])
    from_eye = points - (np.array(look["center"]) + look["fit"] / look["zoom"] * back)
    right = np.array([-np.sin(turn), np.cos(turn), 0.0])
    depth = -from_eye @ back
    flat = np.stack([from_eye @ right, -from_eye @ np.cross(back, right)], axis=1) / depth[:, None]
    np.testing.assert_allclose(seen[:, 2], depth, rtol=1e-9)
    np.testing.assert_allclose(np.diff(seen[:, :2], axis=0), 1.6 * max(size) * np.diff(flat, axis=0), atol=1e-6)


def test_what_stands_before_something_hides_it_also_where_it_reaches_behind_the_eye(page):
    painted = """([distance]) => {
      const lens = lensOf({turn: 0, height: 0, center: [0, 0, 0], fit: 4, zoom: 1, shift: [0, 0]}, 60, 60);
      const sheet = {width: 60, height: 60, pixels: new Uint32Array(3600), nearness: new Float32Array(3600)};
      const faces = {i: [0, 0], j: [1, 2], k: [2, 3]};
      const square = (x, end) => ({x: [x, x, end, end], y: [-9, 9, 9, -9], z: [-9, -9, 9, 9], ...faces});
      const wall = {columns: square(-1, -1), colour: '#0000ff', opacity: 1};
      const front = {columns: square(distance, distance === 1 ? 1 : -5), colour: '#ff0000', opacity: 1};
      for (const item of [front, wall]) paintMesh(sheet, item, lens);
      return [...sheet.pixels].map(pixel => [pixel & 255, (pixel >> 16) & 255]);
    }"""
    colours = np.array(page.evaluate(painted, [1.0]))
    assert (colours[:, 0] > 0).all()
    assert (colours[:, 1] == 0).all()
    through = np.array(page.evaluate(painted, [9.0])).reshape(60, 60, 2)
    assert ((through > 0).sum(axis=2) == 1).all()
    assert (through[..., 0] > 0).any()
    assert (through[..., 1] > 0).any()


def test_what_is_tinted_lets_what_is_behind_it_through_by_its_share(page):
    alpha, red, blue = page.evaluate("""() => {
      const sheet = {width: 1, height: 1, pixels: new Uint32Array(1), nearness: new Float32Array(1)};
      const fill = (colour, opacity, depth) => fillTriangle(
        sheet, [-5, -5, depth, 1], [9, -5, depth, 1], [-5, 9, depth, 1], colour, opacity);
      fill([200, 0, 0], 0.5, 3);
      fill([0, 0, 200], 0.25, 2);
      const pixel = sheet.pixels[0];
      return [pixel >>> 24, pixel & 255, (pixel >> 16) & 255];
    }""")
    # over an empty ground: what each adds to what is seen
    assert alpha / 255 == pytest.approx(1 - 0.5 * 0.75, abs=0.01)
    assert alpha / 255 * red == pytest.approx(200 * 0.5 * 0.75, abs=2)
    assert alpha / 255 * blue == pytest.approx(200 * 0.25, abs=2)


def test_the_keyboard_reaches_every_control_and_shows_where_it_is(page):
    wanted = page.evaluate(
        "() => { window.reached = new Set(); const seen = all('a[href], button, input, summary, [tabindex]')"
        ".filter(one => one.checkVisibility()); seen[0].focus(); reached.add(seen[0]); return seen.length; }"
    )
    look = """() => {
      const one = document.activeElement;
      reached.add(one);
      return [one.outerHTML.slice(0, 80), getComputedStyle(one).outlineStyle];
    }"""
    for _ in range(wanted - 1):
        page.keyboard.press("Tab")
        element, outline = page.evaluate(look)
        assert outline == "solid", element
    assert page.evaluate("() => reached.size") == wanted > 40


def test_curves_are_switched_in_both_figures_and_far_baselines_wait_for_it(page):
    shown = "() => all('.curves').map(one => one._fullData.filter(trace => trace.visible === true).length)"
    assert page.evaluate(shown) == [4, 4]
    page.locator("[data-curve='2']").check()
    assert page.evaluate(shown) == [6, 6]
    page.locator("[data-curve='2']").uncheck()
    assert page.evaluate(shown) == [4, 4]


def test_the_view_prints_as_a_picture_and_nothing_is_cut(page):
    restored(page)
    page.evaluate("() => window.dispatchEvent(new Event('beforeprint'))")
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 688, "height": 900})
    printed = page.evaluate("""async () => {
      const image = find('#view-printed');
      await image.decode();
      const canvas = Object.assign(document.createElement('canvas'), {width: 100, height: 60});
      const pen = canvas.getContext('2d');
      pen.drawImage(image, 0, 0, 100, 60);
      const colours = new Set(new Uint32Array(pen.getImageData(0, 0, 100, 60).data.buffer));
      return [image.checkVisibility(), colours.size, find('#view-scene').checkVisibility(),
              all('details').every(fold => fold.open), document.documentElement.scrollWidth];
    }""")
    page.emulate_media(media="screen")
    page.set_viewport_size({"width": 480, "height": 360})
    page.evaluate("() => window.dispatchEvent(new Event('afterprint'))")
    visible, colours, live, opened, width = printed
    assert (visible, live, opened) == (True, False, True)
    assert colours > 50
    assert width <= 688
    assert not page.evaluate("() => all('details').every(fold => fold.open)")


def test_a_narrow_window_shows_everything_without_scrolling_sideways(page):
    page.set_viewport_size({"width": 390, "height": 700})
    page.evaluate("() => { for (const fold of all('details')) fold.open = true; }")
    settle(page)
    page.wait_for_timeout(500)  # plotly follows a window with a delay
    found = page.evaluate("""() => [
      document.documentElement.scrollWidth,
      all('main *').filter(one => one.checkVisibility() && one.getBoundingClientRect().right > innerWidth + 1).length,
      all('.scroll').filter(one => one.scrollWidth > one.clientWidth + 1).length,
    ]""")
    page.evaluate("() => { for (const fold of all('details')) fold.open = false; }")
    assert found == [390, 0, 0]


def test_every_figure_downloads_as_svg_with_its_legend(opened):
    page = opened[0]
    figures = page.locator(".js-plotly-plot")
    assert page.locator(".modebar-btn").count() == figures.count() > 1
    figures.first.scroll_into_view_if_needed()
    figures.first.hover()
    with page.expect_download() as download:
        figures.first.locator(".modebar-btn").click()
    assert download.value.suggested_filename == "curve-rays.svg"
    picture = ElementTree.parse(download.value.path())
    words = {"".join(node.itertext()) for node in picture.iter("{http://www.w3.org/2000/svg}text")}
    assert any(word.startswith("</script>") for word in words)  # the legend has names as they are
    assert_quiet(opened)
