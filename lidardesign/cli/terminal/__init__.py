"""Shared by commands: options, output, progress, and the shell around them."""
