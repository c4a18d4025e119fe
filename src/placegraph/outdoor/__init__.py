"""Outdoor wing: a sentence finds its place in a city cut from OpenStreetMap (after GOTLoc)."""
