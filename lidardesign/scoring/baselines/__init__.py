"""The rivals of every design."""
