"""What a scene map holds: objects, meshes, rooms, relations, what is seen from where."""
