"""Options of cutting a mesh into objects: a plain struct with units."""

from __future__ import annotations

from dataclasses import dataclass

from placegraph.indoor.options import check_numbers, check_positive


@dataclass(frozen=True, slots=True)
class SegmentOptions:
    """Everything that can be set about cutting; defaults serve rooms scanned at 2 to 5 cm."""

    flatness: float = 0.05
    """How far a triangle of the floor or a wall may lie from its plane [m]."""
    wall_area: float = 1.5
    """Least area of a wall [m2] ..."""
    wall_height: float = 1.2
    """... and how far it reaches from its lowest to its highest point [m]."""
    bend: float = 0.6
    """Concave angle between neighbouring triangles that counts as a full step [rad]."""
    contrast: float = 25.0
    """Difference of colour between neighbours that counts as a full step [CIE76 Delta E]."""
    patch: float = 0.02
    """Area from which on a smooth patch resists being joined over half a step [m2]."""
    gap: float = 0.03
    """Parts that no edge joins touch if they are this close [m]."""
    support: float = 0.12
    """Level surfaces from this area on carry things, which are objects of their own [m2]."""
    thin: float = 0.5
    """Two parts that could stand alone stay apart where the length of their contact is less than
    this share of the smaller one's size, the root of its area."""
    mark: float = 0.05
    """Least area of what hangs on a wall and differs from it by colour alone [m2] ..."""
    carpet: float = 0.5
    """... and of what lies on the floor."""
    least: float = 0.02
    """Area of the smallest object [m2]; what is smaller belongs to what it touches."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_positive(self, "flatness", "wall_area", "bend", "contrast", "patch", "gap", "support")
