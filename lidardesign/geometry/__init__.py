"""Rays, bodies, and where they meet."""
