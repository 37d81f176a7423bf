"""The optional effects, one module each, imported only where a scene calls for them; see `simulate.physics`."""
