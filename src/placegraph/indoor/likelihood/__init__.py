"""How well a pose explains a frame (SG2Loc Sec. 3.3-3.4, Eq. 2)."""
