"""Contents of scene maps: objects, meshes, rooms, relations, visibility from free places."""
