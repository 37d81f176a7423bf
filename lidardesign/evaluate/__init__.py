"""What a design is worth on held-out scenes, against the rivals an engineer would build."""
