"""`placegraph scene ...`."""
