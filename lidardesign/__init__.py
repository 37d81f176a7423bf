"""lidardesign: from simulated scenes of a task to physical LiDAR designs that are proven on held-out scenes.

Importing this package loads nothing heavy; the modules are the data flow:
`density` (learn), `design` (fit, constrain), `simulate`, `evaluate`, `export`.
"""

__version__ = "0.1.0"
__all__ = ["__version__"]
