"""Worlds drawn in ASCII: examples, demo and test worlds."""
