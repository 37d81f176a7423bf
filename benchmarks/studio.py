"""How fast the studio answers: from a handle to rays on the page, from its release to a score, and memory.

A client of the page's own protocol takes the place of a browser: times end where the message with the rays, or the
score, has arrived. The bare cast with a message of its rays takes turns with the handle.

    python benchmarks/studio.py RUN [--rays 600] [--rounds 50]
"""

from __future__ import annotations

import os
import statistics
import threading
import time
from typing import Any

import numpy as np
from common import parser, report

MIB = 2**20


class Client:
    """A tab without a browser: it notes when messages with some text or lines have come."""

    def __init__(self, address: str) -> None:
        import viser
        from websockets.sync.client import connect

        protocol = f"viser-v{viser.__version__}"
        self.socket = connect(address.replace("http", "ws"), subprotocols=[protocol], max_size=None)
        self.news, self.arrived = threading.Condition(), 0
        threading.Thread(target=self.listen, daemon=True).start()

    def listen(self) -> None:
        """Count messages as they come."""
        for _ in self.socket:
            with self.news:
                self.arrived += 1
                self.news.notify_all()

    def quiet(self) -> None:
        """Wait until nothing has come for a while."""
        before = -1
        while before != self.arrived:
            before = self.arrived
            time.sleep(0.25)

    def seconds_until_next(self, act: Any) -> float:
        """The time from an act to the next message [s]."""
        with self.news:
            before, started = self.arrived, time.perf_counter()
            act()
            self.news.wait_for(lambda: self.arrived > before, timeout=30)
            return time.perf_counter() - started


def resident_mib() -> float:
    """Memory of this process [MiB]."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / MIB


def main() -> None:
    """Measure and print."""
    made = parser(__doc__, rounds=50)
    made.add_argument("run", help="a run folder")
    made.add_argument("--rays", type=int, default=600, help="rays per frame (default %(default)s)")
    options = made.parse_args()

    from lidardesign.api.run import open_run
    from lidardesign.simulate.returns import build_casters, simulate_many
    from lidardesign.studio.choices import SensorPose
    from lidardesign.studio.studio import Studio

    run = open_run(options.run)
    # the fit and what designs see, which a run takes without the page
    design = run.fit(sensors=2, rays=options.rays, layout="even", name="even")
    design.simulate(run.scenes("train", run.config.seed)[:20])
    before_mib = resident_mib()
    with Studio(run, design) as studio:
        client = Client(studio.address)
        client.quiet()
        studio.wish("handle", "s0")
        client.quiet()
        pose, scene = studio.choices.poses["s0"], studio._scenes_of(studio.choices)[0]
        casters, rays = build_casters(scene), design.rays(options.rays)

        def bare() -> None:
            found = simulate_many(scene, [rays], casters=casters)[0][0]
            ends = rays.origin_m + np.where(found.returned, found.range_m, rays.gate_m[:, 1])[:, None] * rays.direction
            studio._stage._nodes["/design/rays"].points = np.stack([rays.origin_m, ends], axis=1)

        def drag(number: int) -> SensorPose:
            return SensorPose.of(pose.place_m, np.add(pose.angles_deg, (0.1 * (number + 1), 0, 0)))

        times: dict[str, list[float]] = {"bare cast": [], "handle": []}
        for number in range(options.rounds):
            times["bare cast"].append(client.seconds_until_next(bare))
            client.quiet()
            times["handle"].append(client.seconds_until_next(lambda number=number: studio._drag(drag(number), False)))
            client.quiet()
        scored = []
        for number in range(5):
            text, started = studio._panel._status.content, time.perf_counter()
            studio._drag(drag(100 + number), True)
            while studio._panel._status.content == text:
                time.sleep(0.002)
            scored.append(time.perf_counter() - started)
            client.quiet()
        page_mib = resident_mib() - before_mib
    middle = {name: 1e3 * statistics.median(values) for name, values in times.items()}
    ratios = [one / other for one, other in zip(times["handle"], times["bare cast"], strict=True)]
    rows = [
        ["bare cast and its message [ms]", middle["bare cast"]],
        ["handle to rays [ms]", middle["handle"]],
        ["ratio", statistics.median(ratios)],
        ["release to score [ms]", 1e3 * statistics.median(scored)],
        ["memory beside the run's own [MiB]", page_mib],
    ]
    triangles = sum(len(getattr(body.shape, "faces", ())) for body in scene.bodies)
    caption = f"{options.rays} rays, {triangles} triangles, medians of {options.rounds}"
    report("The studio's answers", {caption: (["what", "median"], rows)}, path=options.json)


if __name__ == "__main__":
    main()
