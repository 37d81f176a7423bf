"""How much of a ray reaches the point that it observes."""
