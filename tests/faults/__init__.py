"""Faults that the program survives: kills at any moment, in the long form beside the suite."""
