"""Ray casting: one small interface, several engines."""

from placegraph.indoor.rays.caster import Backend, Hits, RayCaster

__all__ = ["Backend", "Hits", "RayCaster"]
