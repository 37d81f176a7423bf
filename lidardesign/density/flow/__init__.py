"""The normalizing flow and its bridge to the target."""
