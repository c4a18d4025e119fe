"""A small texture atlas for a simplified mesh, so that few triangles carry sharp colour."""
