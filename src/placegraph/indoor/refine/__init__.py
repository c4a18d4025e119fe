"""Refinement of poses to centimetres (Sec. 3.6 of the paper, and beyond it)."""

from placegraph.indoor.options import DepthNoise, RefineOptions
from placegraph.indoor.refine.camera_correction import find_camera_correction
from placegraph.indoor.refine.refinement import RefineSetup, refine, refine_estimate

__all__ = [
    "DepthNoise",
    "RefineOptions",
    "RefineSetup",
    "find_camera_correction",
    "refine",
    "refine_estimate",
]
