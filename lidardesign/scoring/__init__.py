"""Scores of designs on held-out scenes, beside those of baselines."""
