"""OpenStreetMap files, rooms in them, and Overpass."""
