"""Ground floor: estimates, geometry, files of maps, compiled code."""
