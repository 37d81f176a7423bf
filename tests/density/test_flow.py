"""The flow: a bijection of the box with an honest density, continuous around the circle, finite at every edge."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from support.flows import FLOWS, draw, flow_of

from lidardesign.density.network import DesignFlow


@pytest.mark.parametrize("name", FLOWS)
def test_the_density_is_the_jacobian_of_sampling(name):
    flow = flow_of(name)
    base, context = draw(flow, 10)
    _, log_prob = flow(base, context)
    for row in range(10):
        given = None if context is None else context[[row]]
        jacobian = torch.autograd.functional.jacobian(lambda u, c=given: flow(u[None], c)[0][0], base[row])
        expected = flow.log_base - torch.linalg.slogdet(jacobian).logabsdet
        assert float(log_prob[row].detach()) == pytest.approx(float(expected.detach()), abs=1e-8)


@pytest.mark.parametrize("name", FLOWS)
def test_every_parameter_gets_a_finite_gradient(name):
    flow = flow_of(name, scale=1.0)
    base, context = draw(flow, 64)
    values, log_prob = flow(base, context)
    (log_prob.mean() + values.square().mean()).backward()
    for label, parameter in flow.named_parameters():
        assert parameter.grad is not None, label
        assert torch.isfinite(parameter.grad).all(), label
    last = [parameter for label, parameter in flow.named_parameters() if label.endswith("bias")]
    assert all((parameter.grad != 0).any() for parameter in last)


@pytest.mark.parametrize("name", ["one on a circle", "circle, then two"])
def test_the_density_is_continuous_around_the_circle(name):
    flow = flow_of(name)
    features = flow.features
    others = draw(flow, 40)[0][:, 1:]
    near = 1e-6

    def at(azimuth):
        points = torch.cat([torch.full((40, 1), azimuth, dtype=torch.float64), others[:, : features - 1]], dim=1)
        with torch.no_grad():
            return flow.log_prob(points).numpy()

    np.testing.assert_allclose(at(1 - near), at(near - 1), atol=1e-2)
    # nowhere else is it cut open either: where it changes most it changes smoothly
    grid = np.linspace(-0.99, 0.99, 100)
    jumps = [np.abs(at(float(b)) - at(float(a))).max() for a, b in pairwise(grid)]
    fine = [np.abs(at(float(a + near)) - at(float(a - near))).max() for a in grid[np.argsort(jumps)[-5:]]]
    assert max(fine) < 1e-2


@pytest.mark.parametrize("name", FLOWS)
def test_the_density_of_held_samples_changes_with_the_weights_as_that_of_the_same_points(name):
    flow = flow_of(name, scale=1.5)
    base, context = draw(flow, 64)
    points, held = flow(base, context, held=True)
    assert not points.requires_grad
    foreign = flow.log_prob(points, context)
    torch.testing.assert_close(held, foreign)
    weights = torch.randn(64, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found, expected = (torch.autograd.grad((weights * one).sum(), list(flow.parameters())) for one in (held, foreign))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-8)


def test_a_fresh_flow_is_near_the_identity_and_its_seed_is_all_that_matters():
    periodic, context = FLOWS["all six"]
    options = {"layers": 2, "hidden": 16, "bins": 6, "periodic": periodic}
    first, second = (
        DesignFlow(len(periodic), context, **options, generator=torch.Generator().manual_seed(5)) for _ in range(2)
    )
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(a, b)
    base, _ = draw(first.double(), 200)
    with torch.no_grad():
        _, log_prob = first(base)
    assert (log_prob - first.log_base).abs().max() < 2.0
