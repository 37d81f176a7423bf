"""Real parts: what their makers say of them, where each figure comes from, and how they stand in the design space."""
