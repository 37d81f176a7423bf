"""The constrained mixture of sensors and its expectation maximisation."""
