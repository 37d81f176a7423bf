"""The application layer: runs, fits, refinement and evaluation as whole steps."""
