"""Steps of Adam are those of the paper."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidardesign.density.training.training import BETAS, Adam
from lidardesign.numerics import HALF_DIGITS


class Plain:
    """Algorithm 1 of Kingma and Ba 2015 for one weight, in float64."""

    def __init__(self, weight):
        self.weight, self.count, self.mean, self.square = weight.copy(), 0, 0.0, 0.0

    def step(self, gradient, rate):
        self.count += 1
        self.mean = BETAS[0] * self.mean + (1 - BETAS[0]) * gradient
        self.square = BETAS[1] * self.square + (1 - BETAS[1]) * gradient**2
        mean, square = self.mean / (1 - BETAS[0] ** self.count), self.square / (1 - BETAS[1] ** self.count)
        self.weight -= rate * mean / (np.sqrt(square) + HALF_DIGITS)


@pytest.mark.parametrize(("dtype", "within"), [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_steps_are_those_of_the_paper_with_rates_that_change_and_weights_that_wait(dtype, within):
    generator = np.random.default_rng(0)
    twins = [Plain(generator.normal(size=shape)) for shape in ((3, 2), (4,), (1,))]
    weights = [torch.nn.Parameter(torch.as_tensor(twin.weight, dtype=dtype)) for twin in twins]
    optimiser = Adam(weights, 0.1)
    for turn in range(12):
        optimiser.clear()
        assert all(weight.grad is None for weight in weights)
        optimiser.rate = 0.1 / (1 + turn)
        for index, (twin, weight) in enumerate(zip(twins, weights, strict=True)):
            if index == 2 or (index == 1 and turn % 3 == 0):
                continue  # the last never has a gradient
            gradient = generator.normal(size=twin.weight.shape) * 10.0 ** generator.integers(-3, 4)
            weight.grad = torch.as_tensor(gradient, dtype=dtype)
            twin.step(gradient, optimiser.rate)
        optimiser.step()
    for twin, weight in zip(twins, weights, strict=True):
        np.testing.assert_allclose(weight.detach().numpy(), twin.weight, rtol=within, atol=within)
    assert [weight in optimiser.state for weight in weights] == [True, True, False]
