"""Constraint files, the bounds that follow from them, and the independent checker."""
