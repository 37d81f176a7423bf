"""Distances and importance of bodies on grids, and the compiled loops that read them."""
