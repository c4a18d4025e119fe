"""The indoor wing: a few frames find their pose in a map of objects with coarse meshes."""
