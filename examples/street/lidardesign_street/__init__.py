"""The task street for lidardesign."""
