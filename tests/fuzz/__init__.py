"""Damaged files for every reader: `python -m fuzz.campaign`."""
