"""Refinement of poses to centimetres (Sec. 3.6 of the paper, and beyond it)."""
