"""Training the flow, and measuring how good it became."""
