"""Flats drawn in ASCII, furnished, rendered and walked through."""
