"""Rays and returns under the name that plugins import; they live in `lidardesign.geometry.rays`."""

from lidardesign.geometry.rays import Rays, Returns

__all__ = ["Rays", "Returns"]
