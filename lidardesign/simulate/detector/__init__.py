"""Models of detectors: receiver, laser and histogram."""
