"""Compiled stacks of splines are the array splines: values, inverses, log slopes and every derivative."""

from __future__ import annotations

import numba
import pytest
import torch
from torch import Tensor

from lidardesign.density.network import EDGE, array_splines, splines

BINS, LAYERS = 7, 2


def parameters_of(scale: float, seed: int = 0, count: int = 400, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(count, LAYERS, 3 * BINS + 1, generator=generator, dtype=dtype)


def values_of(seed: int = 1, count: int = 400, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(count, generator=generator, dtype=dtype) - 1) * 0.999


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("scale", [0.1, 1.0, 5.0])
def test_compiled_splines_agree_with_array_splines(scale, inverted, periodic):
    values, parameters = values_of(), parameters_of(scale)
    found = splines(values, parameters, periodic, inverted=inverted)
    for one, expected in zip(found, array_splines(values, parameters, periodic, inverted=inverted), strict=True):
        torch.testing.assert_close(one, expected, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("scale", [0.1, 1.0, 3.0])
def test_their_gradients_agree_by_values_and_by_every_parameter(scale, inverted, periodic):
    weights = values_of(2), values_of(3)
    gradients = []
    for way in (splines, array_splines):
        values, parameters = values_of().requires_grad_(), parameters_of(scale).requires_grad_()
        out, log_slope = way(values, parameters, periodic, inverted=inverted)
        gradients.append(torch.autograd.grad((weights[0] * out + weights[1] * log_slope).sum(), [values, parameters]))
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8 * float(expected.abs().max()))


@pytest.mark.parametrize("periodic", [False, True])
def test_log_slopes_of_held_values_change_as_those_of_the_inverse_at_them(periodic):
    weights, gradients = values_of(2), []
    out, _ = splines(values_of(), parameters_of(1.0), periodic)
    for values, how in ((values_of(), {"held": True}), (out, {"inverted": True})):
        parameters = parameters_of(1.0).requires_grad_()
        found, log_slope = splines(values, parameters, periodic, **how)
        gradients.append(torch.autograd.grad((weights * log_slope).sum(), parameters)[0])
        assert found.requires_grad == ("inverted" in how)
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-8 * float(gradients[0].abs().max()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_inverse_undoes_a_stack(dtype):
    values, parameters = values_of(dtype=dtype), parameters_of(1.0, dtype=dtype)
    out, log_slope = splines(values, parameters, True)
    back, log_slope_there = splines(out, parameters, True, inverted=True)
    # a value that was rounded, or kept off the edge, moves its argument by so much over the slope
    off = (1024 * torch.finfo(dtype).eps + 4 * EDGE * (out.abs() > 1 - 4 * EDGE)) * (1 + torch.exp(-log_slope))
    assert ((back - values).abs() <= off).all()
    if dtype == torch.float64:
        inside = out.abs() < 1 - 4 * EDGE
        torch.testing.assert_close(log_slope_there[inside], log_slope[inside], rtol=0, atol=1e-8)


def test_float32_parameters_cost_only_the_rounding_of_the_parameters():
    values, parameters = values_of(dtype=torch.float32), parameters_of(1.0, dtype=torch.float32)
    found, exact = splines(values, parameters, True), splines(values.double(), parameters.double(), True)
    for single, double in zip(found, exact, strict=True):
        # twice as much where no compiler fuses products and sums: `make coverage`
        most = (128 if numba.config.DISABLE_JIT else 64) * torch.finfo(torch.float32).eps
        assert (single.double() - double).abs().max() <= most * (1 + double.abs().max())


@pytest.mark.hard_case("24")
@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("scale", [10.0, 1000.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("periodic", [False, True])
def test_extreme_parameters_and_edges_stay_finite_inside_the_box(scale, inverted, dtype, periodic):
    parameters = parameters_of(scale, dtype=dtype).requires_grad_()
    values = values_of(dtype=dtype)
    values[:3] = torch.tensor([-1.0, 1.0, 0.0], dtype=dtype)
    values.requires_grad_()
    out, log_slope = splines(values, parameters, periodic, inverted=inverted)
    assert out.abs().max() <= 1
    for part in (out, log_slope, *torch.autograd.grad((out + log_slope).sum(), [values, parameters])):
        assert torch.isfinite(part).all()


def test_splines_do_not_depend_on_their_neighbours():
    values, parameters = values_of(), parameters_of(1.0)
    whole = splines(values, parameters, False)
    part = splines(values[100:107], parameters[100:107], False)
    for all_of_them, some in zip(whole, part, strict=True):
        assert torch.equal(all_of_them[100:107], some)


def test_parameters_that_all_points_share_get_the_summed_gradient():
    values, shared = values_of(), parameters_of(1.0, count=1).requires_grad_()
    splines(values, shared.expand(len(values), -1, -1), True)[1].sum().backward()
    each = shared.detach().repeat(len(values), 1, 1).requires_grad_()
    splines(values, each, True)[1].sum().backward()
    torch.testing.assert_close(shared.grad[0], each.grad.sum(dim=0))


def test_not_a_number_stays_one_and_spoils_no_other_point():
    values, parameters = values_of(), parameters_of(1.0)
    parameters[5] = torch.nan
    out, log_slope = splines(values, parameters, False)
    assert torch.isnan(log_slope[5])
    assert torch.isfinite(log_slope[:5]).all()
    assert torch.isfinite(log_slope[6:]).all()
    assert torch.isfinite(out[6:]).all()
