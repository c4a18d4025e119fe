"""Refinement of poses to centimetres (Sec. 3.6 of the paper, and beyond it)."""

from placegraph.indoor.refine.camera import wrong_camera
from placegraph.indoor.refine.known import refine
from placegraph.indoor.refine.options import DepthNoise, RefineOptions
from placegraph.indoor.refine.refinement import Refining, refined

__all__ = ["DepthNoise", "RefineOptions", "Refining", "refine", "refined", "wrong_camera"]
