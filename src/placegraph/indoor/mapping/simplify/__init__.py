"""Smaller meshes and textures within a bound on the distance."""
