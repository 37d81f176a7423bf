"""What designs see: clouds of returns, and the surface that they cannot see, for other programs."""
