"""Light that comes back by way of other surfaces, rendered in a process of its own."""
