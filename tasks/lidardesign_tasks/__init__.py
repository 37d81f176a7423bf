"""The tasks that ship with lidardesign. They use its public API only, as a third party's plugin does."""
