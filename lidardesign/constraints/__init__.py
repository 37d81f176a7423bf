"""Constraint files (`document`), what they allow at all, and the independent checker (`check`).

Fits keep constraints by `lidardesign.mixture.bounds`.
"""
