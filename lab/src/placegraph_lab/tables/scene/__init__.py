"""Scene maps: size, fusion, changes, sentences."""
