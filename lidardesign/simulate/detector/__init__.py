"""What a receiver and its laser do to light."""
