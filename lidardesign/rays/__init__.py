"""Which of many rays to fire, and how far from the best that is: read `coverage`, `choice`, then `certificate`."""
