"""From a request to a design: sensors, how many, their rays, spinning sensors, and real parts."""
