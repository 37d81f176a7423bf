"""The returns of a design: first hits, gates and outcomes of every ray."""
