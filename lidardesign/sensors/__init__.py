"""Sensors, the designs that they make up, and the files of designs."""
