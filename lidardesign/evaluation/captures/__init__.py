"""Captures of a lab, and designs scored by them."""
