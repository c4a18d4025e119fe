"""OpenStreetMap files, Overpass, and texts about places."""
