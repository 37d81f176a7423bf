"""The baselines of every design."""
