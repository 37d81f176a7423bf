"""What designs are made for: a world of training scenes, and a problem in it that a method solves."""
