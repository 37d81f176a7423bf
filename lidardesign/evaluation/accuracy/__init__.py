"""Accuracy and its cost in time: sweeps over the settings of every numerical choice."""
