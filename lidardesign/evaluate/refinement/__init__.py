"""Refinement on training scenes."""
