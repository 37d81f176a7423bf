"""The method `fibonacci`: as many rays per solid angle everywhere, in no rows that something could stand between."""

import numpy as np
from lidardesign import DesignResult, Rays, ray_design

GOLDEN = (1 + 5**0.5) / 2


class Fibonacci:
    name, summary, api_version = "fibonacci", "a Fibonacci lattice over all directions, from the middle", 1
    needs, is_redrawn = frozenset(), False

    def refuses(self, problem):
        return "only for a number of rays" if problem.rays is None else None

    def design(self, problem):
        world, count = problem.world, problem.rays
        index, lists = np.arange(count), []
        for space in world.spaces:
            (*start, right, bottom, near), (*end, left, top, far) = space.low, space.high
            azimuth = right + (left - right) * (index / GOLDEN % 1)
            height = np.sin(bottom) + (np.sin(top) - np.sin(bottom)) * (index + 0.5) / count
            origin = np.tile(np.add(start, end) / 2, (count, 1))
            gate = np.tile([near, far], (count, 1))
            lists.append(Rays.from_angles(origin, azimuth, np.arcsin(height), gate, np.zeros(count)))
        return DesignResult(ray_design(self.name, lists, world))


FIBONACCI = Fibonacci()
