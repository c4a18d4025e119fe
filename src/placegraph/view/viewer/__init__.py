"""The viewer in 3D."""
