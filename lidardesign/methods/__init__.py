"""Ways to make a design, each a plugin of the entry-point group `lidardesign.methods`."""
