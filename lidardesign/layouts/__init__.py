"""From sensors to rays: grids, density, scans, distributed rays, and tracks."""
