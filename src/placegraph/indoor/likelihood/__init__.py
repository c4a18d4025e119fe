"""Likelihood of a frame at a pose (SG2Loc Sec. 3.3-3.4, Eq. 2)."""
