"""Compiled splines are the array splines: values, inverses, log slopes and every derivative."""

from __future__ import annotations

import pytest
import torch
from support.tables import each_row
from torch import Tensor

from lidardesign.density.flow.splines import EDGE, BoundedSpline, spline

BINS = 7
PERIODIC = torch.tensor([False, True, False])


def parameters_of(scale: float, seed: int = 0, count: int = 400, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * torch.randn(count, len(PERIODIC), 3 * BINS + 1, generator=generator, dtype=dtype)


def values_of(seed: int = 1, count: int = 400, dtype: torch.dtype = torch.float64) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(count, len(PERIODIC), generator=generator, dtype=dtype) - 1) * 0.999


def reference(values: Tensor, parameters: Tensor, inverted: bool) -> tuple[Tensor, Tensor]:
    made = BoundedSpline(*parameters.split([BINS, BINS, BINS + 1], dim=-1), PERIODIC)
    if inverted:
        values = made.inv(values)
        return values, made.call_and_ladj(values)[1]
    return made.call_and_ladj(values)


@each_row("inverted", [False, True])
@each_row("scale", [0.1, 1.0, 5.0])
def test_compiled_splines_agree_with_array_splines(scale, inverted):
    values, parameters = values_of(), parameters_of(scale)
    for found, expected in zip(
        spline(values, parameters, PERIODIC, inverted=inverted), reference(values, parameters, inverted), strict=True
    ):
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


@each_row("inverted", [False, True])
@each_row("scale", [0.1, 1.0, 3.0])
def test_their_gradients_agree_by_values_and_by_every_parameter(scale, inverted):
    weights = values_of(2), values_of(3)
    gradients = []
    for way in (lambda v, p: spline(v, p, PERIODIC, inverted=inverted), lambda v, p: reference(v, p, inverted)):
        values, parameters = values_of().requires_grad_(), parameters_of(scale).requires_grad_()
        out, log_slope = way(values, parameters)
        gradients.append(torch.autograd.grad((weights[0] * out + weights[1] * log_slope).sum(), [values, parameters]))
    for found, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-8 * float(expected.abs().max()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_inverse_undoes_a_spline(dtype):
    values, parameters = values_of(dtype=dtype), parameters_of(2.0, dtype=dtype)
    out, log_slope = spline(values, parameters, PERIODIC)
    back, log_slope_there = spline(out, parameters, PERIODIC, inverted=True)
    # a value that was rounded, or kept off the edge, moves its argument by so much over the slope
    off = (1024 * torch.finfo(dtype).eps + 2 * EDGE * (out.abs() > 1 - 2 * EDGE)) * (1 + torch.exp(-log_slope))
    assert ((back - values).abs() <= off).all()
    if dtype == torch.float64:
        inside = out.abs() < 1 - 2 * EDGE
        torch.testing.assert_close(log_slope_there[inside], log_slope[inside], rtol=0, atol=1e-8)


def test_float32_parameters_cost_only_the_rounding_of_the_parameters():
    values, parameters = values_of(dtype=torch.float32), parameters_of(1.0, dtype=torch.float32)
    found, exact = spline(values, parameters, PERIODIC), spline(values.double(), parameters.double(), PERIODIC)
    for single, double in zip(found, exact, strict=True):
        assert (single.double() - double).abs().max() <= 16 * torch.finfo(torch.float32).eps * (1 + double.abs().max())


@each_row("inverted", [False, True])
@each_row("scale", [10.0, 1000.0])
@each_row("dtype", [torch.float32, torch.float64])
def test_extreme_parameters_and_edges_stay_finite_inside_the_box(scale, inverted, dtype):
    parameters = parameters_of(scale, dtype=dtype).requires_grad_()
    values = values_of(dtype=dtype)
    values[:3] = torch.tensor([[-1.0], [1.0], [0.0]], dtype=dtype)
    values.requires_grad_()
    out, log_slope = spline(values, parameters, PERIODIC, inverted=inverted)
    assert out.abs().max() <= 1
    for part in (out, log_slope, *torch.autograd.grad((out + log_slope).sum(), [values, parameters])):
        assert torch.isfinite(part).all()


def test_splines_do_not_depend_on_their_neighbours():
    values, parameters = values_of(), parameters_of(1.0)
    whole = spline(values, parameters, PERIODIC)
    part = spline(values[100:107], parameters[100:107], PERIODIC)
    for all_of_them, some in zip(whole, part, strict=True):
        assert torch.equal(all_of_them[100:107], some)


def test_parameters_that_all_points_share_get_the_summed_gradient():
    values, shared = values_of(), parameters_of(1.0, count=1).requires_grad_()
    spline(values, shared.expand(len(values), -1, -1), PERIODIC)[1].sum().backward()
    each = shared.detach().repeat(len(values), 1, 1).requires_grad_()
    spline(values, each, PERIODIC)[1].sum().backward()
    torch.testing.assert_close(shared.grad[0], each.grad.sum(dim=0))


def test_not_a_number_stays_one_and_spoils_no_other_point():
    values, parameters = values_of(), parameters_of(1.0)
    parameters[5] = torch.nan
    out, log_slope = spline(values, parameters, PERIODIC)
    assert torch.isnan(log_slope[5]).all()
    assert torch.isfinite(log_slope[:5]).all()
    assert torch.isfinite(log_slope[6:]).all()
    assert torch.isfinite(out[6:]).all()
