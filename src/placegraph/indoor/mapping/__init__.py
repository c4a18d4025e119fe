"""From what the user has to a scene map, and what changed in it."""
