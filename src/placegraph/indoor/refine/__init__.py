"""Refinement of poses to centimetres (Sec. 3.6 of the paper, and beyond it)."""

from placegraph.indoor.refine.options import DepthNoise, RefineOptions
from placegraph.indoor.refine.refinement import chosen_matcher, refine, refine_estimate

__all__ = ["DepthNoise", "RefineOptions", "chosen_matcher", "refine", "refine_estimate"]
