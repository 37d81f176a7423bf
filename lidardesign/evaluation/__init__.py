"""Scores of designs on held-out scenes, against the baselines that an engineer would build.

In reading order: `request` is the request; `entries` lays out designs and baselines; `score` hands their rays
to `scoring.scene_scores`, which scores what they return; `results` and `seeds` make rows and intervals.
"""
