"""Visibility: between 0 and 1, falling with range, blocked by thin plates, refined or honest about what it misses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.visibility import OPTICS, SPACE, along_axis, both_ways, config_of, plate, transmittance_on, wall

from lidardesign.config import DensitySettings
from lidardesign.density.objective.prepare import prepare_target
from lidardesign.density.objective.target import build_target
from lidardesign.scenes.scene import Body, Mesh, Scene, Sphere, rigid
from lidardesign.space import RANGE

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.mark.parametrize("name", ["raycast", "quadrature"])
def test_a_visible_surface_does_not_hide_itself(name):
    for body in (wall(2.0), Body(Sphere(0.5), poses=rigid(translation_m=(2.5, 0, 0))), plate(0.3, 2.15)):
        scene = Scene((body,))
        assert transmittance_on(scene, both_ways(scene)[name], [2.0])[0] > 0.99


def test_auto_casts_rays_where_something_is_in_the_way_and_says_what_it_chose_unless_that_was_decided_before():
    for bodies, name, said in (
        ((wall(),), "off", "visibility off: "),
        ((wall(), plate(0.005, half=0.1)), "raycast", "visibility by ray casting: "),
    ):
        target, notes = prepare_target([Scene(bodies)], config_of("auto"))
        assert target.visibility.name == name
        assert any(note.startswith(said) for note in notes)
    target, notes = prepare_target([Scene((wall(),))], config_of("auto"), visibility="raycast")
    assert (target.visibility.name, notes) == ("raycast", [])


@pytest.mark.parametrize("visibility", ["raycast", "quadrature"])
def test_a_target_does_not_occlude_and_an_occluder_is_not_observed(visibility):
    settings = DensitySettings(sigma_m=0.01, quadrature_points=2048)
    at_wall, at_plate = np.array([[0.0, 0, 0, 0, 0, 2.0]]), np.array([[0.0, 0, 0, 0, 0, 0.95]])

    def values(role):
        target = build_target([Scene((wall(role="target"), plate(0.1, role=role)))], SPACE, settings, visibility)
        return target.log_density(np.concatenate([at_wall, at_plate]))

    clear_wall, seen_plate = values("target")
    assert clear_wall > math.log(0.99)
    assert seen_plate > math.log(0.99)
    hidden_wall, unseen_plate = values("occluder")
    assert hidden_wall < math.log(0.01)
    assert unseen_plate < -1000
    hidden_wall, seen_plate = values("both")
    assert hidden_wall < math.log(0.01)
    assert seen_plate > math.log(0.99)


def open_sheet(distance):
    corners = np.array([(distance, y, z) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    return Body(Mesh(corners, np.array([[0, 1, 2], [1, 3, 2]]), "unsigned"), f"sheet at {distance}")


@pytest.mark.parametrize("visibility", ["raycast", "quadrature"])
def test_an_open_sheet_hides_what_is_behind_it_but_not_itself(visibility):
    settings = DensitySettings(sigma_m=0.01, quadrature_points=1024, field_resolution=48)
    target = build_target([Scene((open_sheet(1.0), open_sheet(2.0)))], SPACE, settings, visibility)
    ranges = np.linspace(0.95, 1.05, 401)
    points = np.zeros((401, 6))
    points[:, RANGE] = ranges
    values = target.log_density(points)
    # interpolated unsigned distances are blunt at the surface: the peak is only known to half a cell
    assert abs(ranges[values.argmax()] - 1.0) < target.surfaces.field.grid.step / 2
    assert transmittance_on(None, target.visibility, [1.0], target.optics)[0] > 0.99
    assert transmittance_on(None, target.visibility, [2.0], target.optics)[0] < 0.01


def test_only_active_pairs_are_computed_and_the_rest_is_clear():
    scene = Scene((plate(0.1), wall()))
    for visibility in both_ways(scene).values():
        active = np.array([[True], [False]])
        log_values = visibility.transmittance(along_axis([2.0, 2.0]), active, OPTICS).log_values
        assert log_values[0, 0] < math.log(0.01)
        assert log_values[1, 0] == 0.0


def test_widening_keeps_the_optics_in_proportion():
    wide = OPTICS.widened(10 * OPTICS.sigma_m)
    assert wide.margin_m == pytest.approx(10 * OPTICS.margin_m)
    assert wide.attenuation_per_m * wide.margin_m == pytest.approx(OPTICS.attenuation_per_m * OPTICS.margin_m)
