"""Scenes, their bodies, and where rays meet them."""
