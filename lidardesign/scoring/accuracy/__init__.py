"""What accuracy costs in time: sweeps over the settings of every numerical choice."""
