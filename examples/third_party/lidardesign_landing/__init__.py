"""The task landing for lidardesign."""
