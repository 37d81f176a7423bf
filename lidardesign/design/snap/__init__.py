"""Fitted sensors replaced by real parts."""
