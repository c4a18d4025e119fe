"""How files that ship with placegraph are made: lexicons, decoys, what all surfaces share."""
