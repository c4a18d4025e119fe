"""Fusion: RGB-D frames with poses become a coloured mesh."""

from placegraph.indoor.fuse.fusion import fuse
from placegraph.indoor.fuse.result import Fused, FuseOptions, FuseStats

__all__ = ["FuseOptions", "FuseStats", "Fused", "fuse"]
