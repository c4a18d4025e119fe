"""`placegraph library`: many scene maps, searched at once."""
