"""Robots that MuJoCo can load: what moves, what sensors are to find of it, and how well they do."""
