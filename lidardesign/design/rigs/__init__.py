"""Rigs that others made, read as designs."""
