"""From frames to a judged pose: motion, particles, filter, polish, verdict (SG2Loc Sec. 3.2, 3.5)."""
