"""Training of the outdoor matching network (GOTLoc Eq. 17-19)."""
