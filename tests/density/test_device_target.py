"""The target as tensors is the target as compiled loops, and learns the same."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh

from lidardesign.config import DensitySettings
from lidardesign.density.coordinates import (
    Coordinates,
    DeviceTarget,
    log_target,
    log_target_values,
    on_device,
)
from lidardesign.density.network import DesignFlow
from lidardesign.density.objective.target import build_target
from lidardesign.density.training.losses import Pool, balancing_loss, pathwise_loss
from lidardesign.errors import NumericalError
from lidardesign.scenes.scene import Body, Mesh, Scene, rigid
from lidardesign.space import DesignSpace

CPU = torch.device("cpu")
FIXED = DesignSpace((0, 0, 0, -0.4, -0.4, 0.5), (0, 0, 0, 0.4, 0.4, 3.0))
FREE = DesignSpace((-0.2, -0.2, -0.2, -0.4, -0.4, 0.5), (0.2, 0.2, 0.2, 0.4, 0.4, 3.0), measure="angles")


def scenes(weighted=False):
    ball, slab = trimesh.creation.icosphere(subdivisions=2, radius=0.3), trimesh.creation.box((0.1, 0.3, 0.3))
    # from right to left the surface counts twentyfold
    target = Mesh(ball.vertices, ball.faces, importance=np.exp(5.0 * ball.vertices[:, 1]) if weighted else None)
    before = Mesh(slab.vertices, slab.faces)
    return [
        Scene(
            (
                Body(target, "target", "both", rigid(translation_m=(2.0 + 0.1 * n, 0, 0))),
                Body(before, "slab", "occluder", rigid(translation_m=(1.2, 0.1 * n, 0))),
            ),
            f"scene {n}",
        )
        for n in range(3)
    ]


@cache
def targets(space, visibility, weighted=False):
    settings = DensitySettings(sigma_m=0.03, field_resolution=24, quadrature_points=32)
    host = replace(build_target(scenes(weighted), space, settings, visibility), surface_tolerance_nats=200.0)
    return host, on_device(host, CPU)


@pytest.mark.parametrize(
    ("space", "visibility"),
    [(FIXED, "off"), (FIXED, "quadrature"), (FREE, "quadrature")],
    ids=["fixed origin, off", "fixed origin", "free origin, in angles"],
)
@pytest.mark.parametrize("sigma_m", [None, 0.1])
@pytest.mark.parametrize("weighted", [False, True])
def test_values_and_gradients_are_those_of_the_compiled_loops(space, visibility, sigma_m, weighted):
    host, device = targets(space, visibility, weighted)
    assert isinstance(device, DeviceTarget)
    coordinates = Coordinates(space)
    generator = torch.Generator().manual_seed(0)
    unit = 2 * torch.rand(500, len(space.free), generator=generator, dtype=torch.float64) - 1
    found, expected = [], []
    for target, kept in ((host, expected), (device, found)):
        leaf = unit.clone().requires_grad_()
        values = log_target(leaf, target, coordinates, sigma_m or target.optics.sigma_m)
        kept += [values.detach(), torch.autograd.grad(values.sum(), leaf)[0]]
    near = expected[0] > expected[0].max() - 50
    assert near.sum() > 50
    torch.testing.assert_close(found[0][near], expected[0][near], rtol=1e-4, atol=1e-3)
    size = expected[1][near].abs().max()
    assert ((found[1] - expected[1])[near].abs().max(dim=1).values < 1e-3 * size).double().mean() > 0.99
    if sigma_m is None:
        values = log_target_values(unit, device, coordinates)
        torch.testing.assert_close(values, found[0])


def flow_of(space):
    coordinates = Coordinates(space)
    generator = torch.Generator().manual_seed(1)
    flow = DesignFlow(len(coordinates.learned), 0, layers=2, hidden=16, bins=8, generator=generator)
    return flow.double(), coordinates


@pytest.mark.parametrize("loss", ["along paths", "by values"])
def test_a_step_has_the_same_loss_and_gradient(loss):
    losses, gradients = [], []
    for target in targets(FIXED, "quadrature"):
        flow, coordinates = flow_of(FIXED)
        generator = torch.Generator().manual_seed(2)
        if loss == "along paths":
            value = pathwise_loss(flow, target, coordinates, 256, 0.1, 0.1, generator)[0]
        else:
            points = FIXED.sample(512, np.random.default_rng(3))
            pool = Pool.of(FIXED.to_unit(points), target.log_density(points), np.zeros(512)).to(CPU)
            value = balancing_loss(flow, target, coordinates, 256, pool, generator)[0]
        value.backward()
        losses.append(float(value.detach()))
        gradients.append(torch.cat([parameter.grad.ravel() for parameter in flow.parameters()]))
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)
    assert (gradients[1] - gradients[0]).norm() < 2e-3 * gradients[0].norm()


@pytest.mark.parametrize("weighted", [False, True])
def test_columns_that_are_drawn_stand_for_all_on_the_device_too(weighted):
    host, device = targets(FIXED, "quadrature", weighted)
    chosen, unit = np.array([0, 2]), torch.zeros(4, 3, dtype=torch.float64)
    few = device.subsample(chosen)
    assert isinstance(few, DeviceTarget)
    # its tables went to the device once, not for every step's columns anew
    for name in ("_table", "_occluders", "_weights"):
        assert getattr(few, name) is getattr(device, name)
    points = FIXED.from_unit(unit.numpy())
    np.testing.assert_allclose(few.log_density_of_unit(unit), host.subsample(chosen).log_density(points), rtol=1e-4)


def test_what_needs_rays_cast_stays_on_the_processor():
    host, _ = targets(FIXED, "raycast")
    assert on_device(host, CPU) is host


def test_points_that_are_not_finite_are_refused_as_on_the_processor():
    _, device = targets(FIXED, "off")
    unit = torch.full((2, 3), torch.nan, dtype=torch.float64)
    with pytest.raises(NumericalError, match="not finite"):
        log_target_values(unit, device, Coordinates(FIXED))
