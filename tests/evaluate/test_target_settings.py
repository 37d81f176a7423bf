"""Distance fields for a tolerance: the coarsest that are good enough, or what the user asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.learning import config_of
from support.meshes import icosphere

from lidardesign.evaluate.accuracy.fields import FIELD_SHARE, RESOLUTIONS, fields_within
from lidardesign.scene import Body, Scene, Sphere, rigid
from lidardesign.space import DesignSpace

SPACE = DesignSpace((0, 0, 0, -0.4, -0.4, 0.2), (0, 0, 0, 0.4, 0.4, 2.5))


def thin_shells(**density):
    config = config_of(SPACE)
    return replace(config, density=config.density.model_copy(update={"sigma_m": 0.02, **density}))


@pytest.fixture(scope="module")
def meshes():
    return [Scene((Body(icosphere(centre=(1.5, 0.05 * n, 0)), poses=np.eye(4)),)) for n in range(2)]


@pytest.fixture(scope="module")
def choices(meshes):
    config = thin_shells()
    return {tolerance: fields_within(meshes, config, tolerance, fixed=False) for tolerance in (0.9, 0.05)}


def test_the_coarsest_fields_within_a_fifth_of_the_tolerance_are_taken(choices):
    rough, fine = choices[0.9], choices[0.05]
    assert rough.density.field_resolution < fine.density.field_resolution
    for tolerance, choice in choices.items():
        assert choice.misplaced <= FIELD_SHARE * tolerance
        assert choice.density.field_resolution in RESOLUTIONS
        assert str(choice.density.field_resolution) in choice.note


def test_a_coarser_field_would_not_have_done(meshes, choices):
    chosen = choices[0.05].density.field_resolution
    coarser = [resolution for resolution in RESOLUTIONS if resolution < chosen]
    held = fields_within(meshes, thin_shells(field_resolution=coarser[-1]), 0.05, fixed=True)
    assert held.misplaced > FIELD_SHARE * 0.05


def test_a_resolution_of_the_users_own_is_kept_and_measured(meshes):
    choice = fields_within(meshes, thin_shells(field_resolution=17), 1e-6, fixed=True)
    assert choice.density.field_resolution == 17
    assert choice.misplaced > 1e-6


def test_primitives_have_exact_distances_and_nothing_to_choose():
    scenes = [Scene((Body(Sphere(0.5), poses=rigid(translation_m=(1.5, 0, 0))),))]
    config = thin_shells()
    choice = fields_within(scenes, config, 0.1, fixed=False)
    assert choice.density == config.density
    assert (choice.misplaced, choice.note) == (0.0, "")
