"""Fusion: RGB-D frames with poses become a coloured mesh."""

from placegraph.indoor.mapping.fuse.fusion import Fused, FuseOptions, FuseStats, fuse

__all__ = ["FuseOptions", "FuseStats", "Fused", "fuse"]
