"""Flows of every kind of space, with weights at random."""

from __future__ import annotations

import torch

from lidardesign.density.flow.flow import DesignFlow

# name -> (blocks, context, periodic): adding a flow to every law below is adding a line
FLOWS = {
    "one dimension": ([[0]], 0, [False]),
    "one on a circle": ([[0]], 0, [True]),
    "a block of two": ([[0, 1]], 0, [False, False]),
    "circle, then two blocks": ([[0], [1], [2]], 0, [True, False, False]),
    "all six": ([[0, 1, 2], [3], [4], [5]], 0, [False, False, False, True, False, False]),
    "one, given one": ([[0]], 1, [False]),
    "chain, given two": ([[0, 1], [2]], 2, [False, False, False]),
}


def flow_of(name, layers=3, scale=3.0, seed=0):
    """A flow away from the identity: its last layers are scaled up."""
    blocks, context, periodic = FLOWS[name]
    generator = torch.Generator().manual_seed(seed)
    flow = DesignFlow(
        blocks, context, layers=layers, hidden=16, bins=6, periodic=periodic, generator=generator
    ).double()
    with torch.no_grad():
        for parameter in flow.parameters():
            parameter.mul_(scale)
    return flow


def draw(flow, count, seed=1):
    return flow.draw(count, torch.Generator().manual_seed(seed))
