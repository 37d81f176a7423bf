"""What a lab captured, and designs scored by it."""
