"""What a capture with known poses says of a map: what moved, vanished and appeared."""
