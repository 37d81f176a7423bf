"""Simulation of returns: first hits, gates, detectors and optional physical effects."""
