"""Training of the compact encoder."""
