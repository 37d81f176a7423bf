"""The rival that optimises the metric directly, by CMA-ES."""
