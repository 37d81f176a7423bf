"""Held-out scenes scored by processes of this machine or of a cluster."""
