"""Adam's steps over the weights of a flow (Kingma and Ba 2015, arXiv:1412.6980), as `torch.optim.Adam` takes them.

The steps are PyTorch's own function, and equal bit for bit. Its class imports the compiler of PyTorch, which nothing
here uses, when it is made: that takes as long again as importing PyTorch, in every process that learns.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch.optim.adam import adam

from lidardesign.numerics import HALF_DIGITS

# How much of the means of gradients and of their squares a step keeps.
BETAS = (0.9, 0.99)
MOMENTS = ("exp_avg", "exp_avg_sq")


class Adam:
    """Steps of one size for all weights, each along its own mean gradient over the root of its mean square.

    Arguments:
        parameters: The weights, which are changed in place.
        rate: The step size; may be set between steps.

    `state` holds the means and the count of steps by weight; a weight without a gradient is left alone and has none.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], rate: float) -> None:
        self.parameters = list(parameters)
        self.rate = rate
        self.state: dict[torch.Tensor, dict[str, torch.Tensor]] = {}

    def clear(self) -> None:
        """Forget all gradients."""
        for parameter in self.parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """Change every weight that has a gradient."""
        moved = [parameter for parameter in self.parameters if parameter.grad is not None]
        states = [self._state_of(parameter) for parameter in moved]
        adam(
            moved,
            [parameter.grad for parameter in moved],
            *([state[name] for state in states] for name in MOMENTS),
            [],
            [state["step"] for state in states],
            fused=True,  # one pass over the weights, a fifth of the time
            amsgrad=False,
            beta1=BETAS[0],
            beta2=BETAS[1],
            lr=self.rate,
            weight_decay=0.0,
            eps=HALF_DIGITS,
            maximize=False,
        )

    def _state_of(self, parameter: torch.Tensor) -> dict[str, torch.Tensor]:
        if not self.state.get(parameter):
            moments = {name: torch.zeros_like(parameter, memory_format=torch.preserve_format) for name in MOMENTS}
            # fused steps are counted on the device of the weight
            self.state[parameter] = {"step": torch.zeros((), dtype=torch.float32, device=parameter.device), **moments}
        return self.state[parameter]
