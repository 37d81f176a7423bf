"""Scenes, their bodies, mesh files and ray casting."""
