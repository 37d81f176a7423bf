"""Flows of every kind of space, with weights at random."""

from __future__ import annotations

import torch

from lidardesign.density.network import DesignFlow

# name -> (which dimensions lie on a circle, conditions): adding a flow to every law below is adding a line
FLOWS = {
    "one dimension": ([False], 0),
    "one on a circle": ([True], 0),
    "two dimensions": ([False, False], 0),
    "circle, then two": ([True, False, False], 0),
    "all six": ([False, False, False, True, False, False], 0),
    "one, given one": ([False], 1),
    "three, given two": ([False, False, False], 2),
}


def flow_of(name, layers=3, scale=3.0, seed=0):
    """A flow away from the identity: its last layers are scaled up."""
    periodic, context = FLOWS[name]
    generator = torch.Generator().manual_seed(seed)
    flow = DesignFlow(
        len(periodic), context, layers=layers, hidden=16, bins=6, periodic=periodic, generator=generator
    ).double()
    with torch.no_grad():
        for parameter in flow.parameters():
            parameter.mul_(scale)
    return flow


def draw(flow, count, seed=1):
    return flow.draw(count, torch.Generator().manual_seed(seed))
