"""Fusion: RGB-D frames with poses become a coloured mesh."""

from placegraph.indoor.mapping.fuse.fusion import fuse
from placegraph.indoor.mapping.fuse.result import Fused, FuseOptions, FuseStats

__all__ = ["FuseOptions", "FuseStats", "Fused", "fuse"]
