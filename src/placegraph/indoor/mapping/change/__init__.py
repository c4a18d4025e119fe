"""Changes since a map was made: found between maps or by a capture, and taken over."""
