"""Designs: constrained mixtures of physical sensors, their rays and their files."""
