"""From OpenStreetMap to objects, cells, cell graphs and their index (GOTLoc Eq. 1-2, 5-8)."""
