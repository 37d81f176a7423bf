"""A receiver and its laser."""
