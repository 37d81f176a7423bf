"""The studio's page in a browser: what a user drags, types and clicks, and what comes of it."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.browsers import opened_browser
from support.mesh_runs import make_mesh_run
from support.studios import PATIENCE_S, wait_for

pytest.importorskip("viser", reason="viser is not installed (extra: studio)")

from lidardesign.api.run import open_run
from lidardesign.studio.stage import HANDLE_SIZE
from lidardesign.studio.studio import Studio


@pytest.fixture(scope="module")
def browser():
    with opened_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    folder = make_mesh_run(tmp_path_factory.mktemp("studio") / "balls", overrides=["task.origin_box_m=[0.2, 0.2, 0.2]"])
    run = open_run(folder)
    run.fit(sensors=2, rays=16, name="two").save()
    return run


class Tab:
    """A tab of the browser with the page, ready to be used."""

    def __init__(self, browser, studio):
        known = {*studio._server.get_clients()}
        self.page, self.errors = browser.new_page(viewport={"width": 1440, "height": 900}), []
        self.page.set_default_timeout(1000 * PATIENCE_S)
        self.page.on("console", lambda line: self.errors.append(line.text) if line.type == "error" else None)
        self.page.goto(studio.address)
        self.page.get_by_text("kept for comparing").wait_for()
        (number,) = {*studio._server.get_clients()} - known
        self.client = studio._server.get_clients()[number]

    def open(self, name):
        self.page.get_by_role("tab", name=name, exact=True).click()

    def field(self, label):
        named = self.page.get_by_text(label, exact=True).locator("visible=true").first
        return named.locator("xpath=ancestor::*[.//input][1]//input[not(@type='hidden')]").first

    def pixel(self, place_m):
        """Where a place is seen, by the camera that the browser reports."""
        camera, box = self.client.camera, self.page.locator("canvas").first.bounding_box()
        turn = Rotation.from_quat(np.roll(camera.wxyz, -1)).as_matrix()
        across, down, ahead = turn.T @ (np.asarray(place_m) - camera.position)
        focal = box["height"] / 2 / math.tan(camera.fov / 2)
        return box["width"] / 2 + focal * across / ahead, box["height"] / 2 + focal * down / ahead

    def drag(self, start, end, steps=6):
        self.page.mouse.move(*start)
        time.sleep(0.3)  # the handle lights up
        self.page.mouse.down()
        for share in np.linspace(0, 1, steps + 1)[1:]:
            self.page.mouse.move(*(np.array(start) + share * np.subtract(end, start)))
            time.sleep(0.1)
        self.page.mouse.up()


def test_a_sensor_that_is_dragged_takes_its_rays_along_and_is_fixed_in_every_tab(balls, browser):
    with Studio(balls) as studio:
        tab, other = Tab(browser, studio), Tab(browser, studio)
        for one in (tab, other):
            one.open("Move")
        before = studio.choices
        sensor = before.sensors[0]
        tab.page.mouse.click(*tab.pixel(sensor.origin_m))
        wait_for(lambda: tab.field("handle on").input_value() == "s0")
        # by the arrow that points up
        arrow_m = HANDLE_SIZE * studio._stage.extent_m * sensor.frame[2]
        tab.drag(tab.pixel(sensor.origin_m + 0.95 * arrow_m), tab.pixel(sensor.origin_m + 1.3 * arrow_m))
        wait_for(lambda: studio.choices is not before)
        after = studio.choices
        moved = after.sensors[0].origin_m
        assert moved[2] > sensor.origin_m[2] + 0.01
        assert after.constraints["each"][0]["origin"]["fixed_m"] == moved.tolist()
        assert after.constraints["sensors"] == {"count": 2}
        own = after.design.rays(16).sensor == 0
        assert (after.design.rays(16).origin_m[own] == moved).all()
        kept = before.design.rays(16).direction
        np.testing.assert_allclose(after.design.rays(16).direction, kept, rtol=0, atol=1e-12)
        for one in (tab, other):
            one.page.get_by_text("fixed: place").wait_for()
            one.page.get_by_text("before the last change").wait_for()
            assert float(one.field("x, y, z [m]").input_value().split(",")[0]) == pytest.approx(moved[0], abs=6e-4)
        tab.page.get_by_role("button", name="Undo", exact=True).click()
        wait_for(lambda: studio.choices is before)
        other.page.get_by_text("may place it elsewhere").wait_for()
        other.field("azimuth, elevation, roll [deg]").fill("10, 5, 0")
        other.field("azimuth, elevation, roll [deg]").press("Enter")
        wait_for(lambda: studio.choices is not before)
        assert studio.choices.poses["s0"].angles_deg == pytest.approx((10, 5, 0), abs=0.02)
        assert not tab.errors
        assert not other.errors
