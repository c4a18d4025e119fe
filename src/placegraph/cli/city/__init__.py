"""`placegraph city ...`."""
