"""Rigs that others made, read as designs: what a file is shows in its content, not in its name."""
