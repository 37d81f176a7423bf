"""The long runs that `make soak` does beside the suite: random whole runs, and learning from many seeds."""
