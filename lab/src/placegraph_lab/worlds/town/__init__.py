"""Towns drawn in ASCII."""
