"""Which scene is it."""
