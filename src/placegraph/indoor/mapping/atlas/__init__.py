"""A small texture atlas for a simplified mesh, so that few triangles carry sharp colour."""

from placegraph.indoor.mapping.atlas.baking import ColourOf, bake
from placegraph.indoor.mapping.atlas.colours import frame_colours, mesh_colours, surface_colours

__all__ = ["ColourOf", "bake", "frame_colours", "mesh_colours", "surface_colours"]
