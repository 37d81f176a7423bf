"""Multipath light: an upper bound, and a light-transport simulator in a process of its own."""
