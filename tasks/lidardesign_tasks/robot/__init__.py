"""Robots as MuJoCo models: motion, targets and scores."""
