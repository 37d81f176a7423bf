"""The target density over design points (paper, eq. 3 to 5)."""
