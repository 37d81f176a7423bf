"""Runs on disk: configuration, YAML with positions, checkpoints, manifest. A side library of all commands."""
