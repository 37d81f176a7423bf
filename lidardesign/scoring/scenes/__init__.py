"""What one set of rays is worth in one scene, and intervals over scenes."""
