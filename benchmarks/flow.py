"""One step of the flow: samples with their log density, and the gradients of all weights, against other libraries.

Every contestant maps the same uniform base points to samples with their log density and takes the gradient of
`mean(log q + |x|^2 / 2)` by its weights; the optimiser is left out. All have the same dimensions, spline bins, as many
splines for each dimension, and networks of two hidden layers, in the same arithmetic. Ours has one network for each
dimension, which finds the parameters of all its splines; the others have one masked network for each layer. Each
library runs in the direction in which sampling takes one network pass a layer, and zuko also in its default one. Log
densities are held against the Jacobian that automatic differentiation finds. Two floors are timed beside them: the
masked networks' matrix products alone, with unmasked weights, and those with one exponential for each of their outputs.

    python -m pip install -r benchmarks/requirements.txt      # the libraries that are compared with
    python benchmarks/flow.py [--compile]
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import common  # noqa: F401 (before torch: it limits the thread pools)
import torch
import zuko
from common import Timing, installed, interleaved, median_ratio, parser, report, verdict
from torch import Tensor, nn
from zuko.lazy import LazyInverse
from zuko.transforms import MonotonicRQSTransform

from lidardesign.density.network import DesignFlow

FEATURES = 6
CHECKED_POINTS = 32
# Base points stay inside the box by this much, as those of learning do; at the edge itself libraries differ.
EDGE = 1e-6
# Marks what torch.compile made of another row; its arithmetic is checked there.
COMPILED = ", compiled"
COMPILED_TOO = ("lidardesign", "zuko, inverted")


@dataclass(frozen=True)
class Sizes:
    """What all contestants share: batch, layers, bins, hidden width, and the arithmetic."""

    batch: int
    layers: int
    bins: int
    hidden: int
    dtype: torch.dtype


class Alternating(nn.Module):
    """Layers of a library that knows one order, with the dimensions turned round after each one."""

    def __init__(self, layers: list[nn.Module]) -> None:
        super().__init__()
        self.layers = nn.ModuleList(layers)

    def forward(self, base: Tensor) -> tuple[Tensor, Tensor]:
        """Samples and log density of base points in [-1, 1]: (N, D) to (N, D) and (N,)."""
        values, total = (base + 1) / 2, torch.full_like(base[:, 0], -base.shape[1] * math.log(2))
        for layer in self.layers:
            values, log_slope = layer(values)
            values, total = values.flip(1), total - log_slope.reshape(-1)
        return 2 * values - 1, total


class Zuko(nn.Module):
    """zuko's layers on [-1, 1], so that sampling is one pass (inverted) or one pass a dimension (its default)."""

    def __init__(self, sizes: Sizes, inverted: bool) -> None:
        super().__init__()
        layers = []
        for layer in range(sizes.layers):
            rank = torch.arange(FEATURES)
            made = zuko.flows.autoregressive.MaskedAutoregressiveTransform(
                FEATURES,
                0,
                order=rank if layer % 2 == 0 else rank.flip(0),
                univariate=partial(MonotonicRQSTransform, bound=1.0),
                shapes=[(sizes.bins,), (sizes.bins,), (sizes.bins - 1,)],
                hidden_features=(sizes.hidden, sizes.hidden),
            )
            layers.append(LazyInverse(made) if inverted else made)
        self.layers = nn.ModuleList(layers)

    def forward(self, base: Tensor) -> tuple[Tensor, Tensor]:
        """Samples and log density: (N, D) to (N, D) and (N,)."""
        values, total = base, torch.full_like(base[:, 0], -base.shape[1] * math.log(2))
        for layer in reversed(self.layers):
            values, log_slope = layer().inv.call_and_ladj(values)
            total = total - log_slope
        return values, total


class Products(nn.Module):
    """The matrix products of the networks and nothing else, or with one exponential of their outputs."""

    def __init__(self, sizes: Sizes, exponential: bool) -> None:
        super().__init__()
        outputs, hidden = FEATURES * (3 * sizes.bins + 1), sizes.hidden
        self.layers = nn.ModuleList(
            nn.Sequential(nn.Linear(FEATURES, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, outputs))
            for _ in range(sizes.layers)
        )
        self.exponential = exponential

    def forward(self, base: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing that means anything, in the shapes of the others."""
        total = torch.zeros_like(base[:, 0])
        for layer in self.layers:
            outputs = layer(base)
            total = total + (outputs.exp() if self.exponential else outputs).sum(dim=1)
        return base, total


def ours(sizes: Sizes) -> nn.Module:
    """This library's flow."""
    return DesignFlow(
        FEATURES,
        layers=sizes.layers,
        hidden=sizes.hidden,
        bins=sizes.bins,
        generator=torch.Generator().manual_seed(0),
    )


def nflows(sizes: Sizes) -> nn.Module:
    """nflows on its unit box, without tails: its fastest splines, and all knot slopes are learned as in ours."""
    from nflows.transforms.autoregressive import MaskedPiecewiseRationalQuadraticAutoregressiveTransform as Layer

    network = {"hidden_features": sizes.hidden, "num_blocks": 1, "use_residual_blocks": False}
    return Alternating([Layer(features=FEATURES, num_bins=sizes.bins, **network) for _ in range(sizes.layers)])


def normflows(sizes: Sizes) -> nn.Module:
    """normflows on the unit box, without tails."""
    from normflows.flows.neural_spline.autoregressive import MaskedPiecewiseRationalQuadraticAutoregressive as Layer

    network = {"hidden_features": sizes.hidden, "num_blocks": 1, "use_residual_blocks": False}
    return Alternating([Layer(features=FEATURES, num_bins=sizes.bins, **network) for _ in range(sizes.layers)])


def contestants(sizes: Sizes, compiled: bool) -> dict[str, nn.Module]:
    """All flows that can be made here, ours first; what is not installed is said."""
    makers: dict[str, Callable[[], nn.Module]] = {
        "lidardesign": partial(ours, sizes),
        "zuko, default direction": lambda: Zuko(sizes, inverted=False),
        "zuko, inverted": lambda: Zuko(sizes, inverted=True),
    }
    for name, maker in (("nflows", nflows), ("normflows", normflows)):
        if installed(name):
            makers[f"{name}, one pass"] = partial(maker, sizes)
    made = {}
    for name, make in makers.items():
        # the libraries draw their first weights from torch's global stream
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            made[name] = make().to(sizes.dtype)
        if compiled and name in COMPILED_TOO:
            made[f"{name}{COMPILED}"] = torch.compile(made[name])
    return made


def step(flow: nn.Module, base: Tensor) -> Callable[[], None]:
    """One gradient of all weights."""

    def run() -> None:
        flow.zero_grad(set_to_none=True)
        values, log_prob = flow(base)
        (log_prob + values.square().sum(dim=1) / 2).mean().backward()

    return run


def jacobian_error(flow: nn.Module, base: Tensor) -> float:
    """Largest difference of the log density from that of automatic differentiation's Jacobian [nats]."""
    worst = 0.0
    for point in base[:CHECKED_POINTS, None]:
        jacobian = torch.autograd.functional.jacobian(lambda one: flow(one)[0][0], point)[:, 0]
        expected = -FEATURES * math.log(2) - torch.linalg.slogdet(jacobian)[1]
        worst = max(worst, abs(float(flow(point)[1].detach() - expected)))
    return worst


def summary(times: dict[str, Timing], forward: dict[str, Timing], flows: dict[str, nn.Module], base: Tensor) -> list:
    """One row per contestant: times, ratio to ours, weights, error."""
    first = next(iter(flows))
    rows = []
    for name, flow in flows.items():
        ratio = median_ratio(times[name].cpu, times[first].cpu)
        weights = sum(parameter.numel() for parameter in flow.parameters())
        alone = 1e3 * forward[name].wall_median if name in forward else ""
        row = [name, 1e3 * times[name].wall_median, 1e3 * times[name].cpu_median, alone, ratio, weights]
        unchecked = isinstance(flow, Products) or name.endswith(COMPILED)
        rows.append([*row, "" if unchecked else jacobian_error(flow, base)])
    return rows


def conclusions(times: dict[str, Timing]) -> list[str]:
    """Ours against the best other library in its one-pass direction, and against what else is a limit."""
    first = next(iter(times))
    others = [name for name in times if not name.startswith(("lidardesign", "zuko, default", "floor"))]
    plain = [name for name in others if not name.endswith(COMPILED)]
    best = min(plain, key=lambda name: times[name].cpu_median)
    beside = [name for name in times if name.startswith("floor") or (name in others and name not in plain)]
    ratios = {name: median_ratio(times[first].cpu, times[name].cpu) for name in (best, *beside)}
    lines = [f"{first} / {name}: {ratio:.2f} (processor time)" for name, ratio in ratios.items()]
    return [*lines, verdict("not slower than the best of the others", {best: ratios[best] <= 1})]


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=9)
    made.add_argument("--batch", type=int, default=2048)
    made.add_argument("--layers", type=int, default=6)
    made.add_argument("--bins", type=int, default=16)
    made.add_argument("--hidden", type=int, default=96)
    made.add_argument("--dtype", choices=("float64", "float32"), default="float64")
    made.add_argument("--compile", action="store_true", help="also ours and zuko under torch.compile: takes minutes")
    options = made.parse_args()
    dtype = getattr(torch, options.dtype)
    sizes = Sizes(options.batch, options.layers, options.bins, options.hidden, dtype)
    flows = contestants(sizes, options.compile)
    flows["floor: products"] = Products(sizes, exponential=False).to(dtype)
    flows["floor: products and exp"] = Products(sizes, exponential=True).to(dtype)
    points = torch.rand(options.batch, FEATURES, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    base = ((2 * points - 1) * (1 - EDGE)).to(dtype)
    times = interleaved({name: step(flow, base) for name, flow in flows.items()}, options.rounds)
    with torch.no_grad():
        # a compiled flow would be compiled once more without gradients
        eager = {name: partial(flow, base) for name, flow in flows.items() if not name.endswith(COMPILED)}
        forward = interleaved(eager, options.rounds)
    columns = ["flow", "step ms", "CPU ms", "forward ms", "CPU / ours", "weights", "log q error, nats"]
    report(
        f"Flow step: {sizes.batch} points, {FEATURES} dimensions, {sizes.layers} layers, {sizes.bins} bins, "
        f"{sizes.hidden} hidden, {options.dtype}",
        {"Medians; ratios are medians within rounds": (columns, summary(times, forward, flows, base))},
        conclusions(times),
        options.json,
    )


if __name__ == "__main__":
    main()
