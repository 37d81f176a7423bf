"""The choice of rays among many, and how far from the best it is: read `coverage`, `choice`, then `certificate`."""
