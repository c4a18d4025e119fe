"""Style: one table from map labels to paints, one palette for light and dark.

The style is quiet: the map is paper, and only what the estimate says is in colour. To change the
looks, change the tables here; pictures and pages read them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from html import escape

POINT, LINE, AREA = 0, 1, 2

PALETTE: dict[str, tuple[str, str]] = {
    "land": ("#f4f1ea", "#14181d"),
    "urban": ("#efebe2", "#181c22"),
    "farm": ("#eef0df", "#181e1a"),
    "grounds": ("#f0e9d6", "#1f1f20"),
    "grass": ("#e0ead0", "#18221b"),
    "park": ("#d3e4c3", "#1a2a1f"),
    "wood": ("#c3d9b4", "#182c20"),
    "pitch": ("#c9e2cd", "#1b2f27"),
    "cemetery": ("#d5dfcb", "#1c2822"),
    "sand": ("#f3e8c8", "#29261d"),
    "rock": ("#e6e2dc", "#22252a"),
    "water": ("#b4d3e2", "#173445"),
    "shore": ("#92bdd1", "#235067"),
    "plaza": ("#f7ecec", "#23222a"),
    "plaza-edge": ("#e2d2d2", "#34323c"),
    "parking": ("#eae8e6", "#1f2329"),
    "building": ("#e0d8cb", "#262b33"),
    "building-edge": ("#cbc1b1", "#363c46"),
    "landmark": ("#d2c3ae", "#353a40"),
    "landmark-edge": ("#b3a28a", "#4c525c"),
    "road": ("#ffffff", "#353c47"),
    "road-edge": ("#d9d1c3", "#0e1115"),
    "main-road": ("#fdf0c9", "#4b4a3f"),
    "main-road-edge": ("#dcc894", "#0e1115"),
    "path": ("#cdb9a3", "#4f4a45"),
    "rail": ("#a9a6ad", "#565b66"),
    "barrier": ("#cfc8bc", "#2f343c"),
    "tree": ("#9dc286", "#2f5237"),
    "minor": ("#b3aca0", "#5a616c"),
    "food": ("#c2722a", "#d9914d"),
    "shop": ("#9a5ba5", "#b98ac3"),
    "civic": ("#8a6a3c", "#c0a374"),
    "health": ("#bf4a55", "#d97d86"),
    "transit": ("#3b74b5", "#76a7dc"),
    "leisure": ("#3f8a63", "#6fb893"),
    "paper": ("#ffffff", "#1c2128"),
    "ink": ("#33312d", "#e8e6e1"),
    "soft-ink": ("#6e6a62", "#a4a8b0"),
    "water-ink": ("#3d7690", "#7fb2ca"),
    "park-ink": ("#4a7440", "#8cb781"),
    "amber": ("#9a5b00", "#f0b44c"),
    "mode": ("#b3261e", "#ff8a7a"),
    "on-mode": ("#ffffff", "#2a0d0a"),
    "for": ("#0b6e69", "#52c7bd"),
    "against": ("#a8326e", "#f08fbf"),
}
"""Colours by name: light, dark."""


@dataclass(frozen=True, slots=True)
class Paint:
    """Paint of one class of objects. Colours are names of the palette; empty draws nothing."""

    form: str
    """``area``, ``line``, ``crown`` (of a tree), or a symbol: ``disc``, ``square``, ``cross``."""
    fill: str
    edge: str = ""
    """Outline of areas, casing of lines, rim of symbols."""
    width: float = 0.0
    """Width of lines, diameter of crowns [m]; diameter of symbols [px]."""
    dash: tuple[float, float] | None = None
    """Drawn and blank length of a dashed line [m]."""
    ink: str = "soft-ink"
    """Colour of lettering."""
    rank: int = 9
    """Lettering of a smaller rank goes first; 9 is never lettered."""
    since: float = 0.0
    """Left out of maps drawn at a smaller scale than this [px/m]."""


PAINTS: dict[str, Paint] = {
    # areas, in painter's order
    "sea": Paint("area", "water", ink="water-ink"),
    "urban": Paint("area", "urban"),
    "farm": Paint("area", "farm"),
    "grounds": Paint("area", "grounds", rank=5),
    "grass": Paint("area", "grass"),
    "cemetery": Paint("area", "cemetery", ink="park-ink", rank=4),
    "park": Paint("area", "park", ink="park-ink", rank=2),
    "wood": Paint("area", "wood", ink="park-ink", rank=4),
    "sand": Paint("area", "sand"),
    "rock": Paint("area", "rock"),
    "pitch": Paint("area", "pitch", ink="park-ink", rank=6),
    "water": Paint("area", "water", "shore", ink="water-ink", rank=2),
    "parking": Paint("area", "parking"),
    "plaza": Paint("area", "plaza", "plaza-edge", rank=3),
    # lines
    "stream": Paint("line", "water", "", 4.0, ink="water-ink", rank=5),
    "river": Paint("line", "water", "", 9.0, ink="water-ink", rank=2),
    "shore": Paint("line", "shore", "", 1.2),
    "barrier": Paint("line", "barrier", "", 0.6, since=0.4),
    "path": Paint("line", "path", "", 0.9, (2.6, 1.8), rank=7, since=0.15),
    "steps": Paint("line", "path", "", 2.4, (0.8, 0.8), rank=8, since=0.4),
    "building": Paint("area", "building", "building-edge"),
    "landmark": Paint("area", "landmark", "landmark-edge", rank=4),
    "service": Paint("line", "road", "road-edge", 3.6, rank=7, since=0.12),
    "promenade": Paint("line", "plaza", "plaza-edge", 5.5, rank=4),
    "street": Paint("line", "road", "road-edge", 6.5, rank=3),
    "main-road": Paint("line", "main-road", "main-road-edge", 9.0, rank=2),
    "motorway": Paint("line", "main-road", "main-road-edge", 12.0, rank=3),
    "tram": Paint("line", "rail", "", 1.4, since=0.2),
    "rail": Paint("line", "rail", "", 2.6, (5.0, 5.0)),
    # points
    "tree": Paint("crown", "tree", "", 6.0, since=0.25),
    "minor": Paint("disc", "minor", "", 4.0, since=1.2),
    "furniture": Paint("square", "minor", "paper", 6.0, since=0.9),
    "leisure": Paint("disc", "leisure", "paper", 8.0, rank=6, since=0.8),
    "transit": Paint("square", "transit", "paper", 9.0, rank=5, since=1.0),
    "shop": Paint("disc", "shop", "paper", 8.0, rank=6, since=0.8),
    "health": Paint("cross", "health", "paper", 8.0, rank=5, since=0.8),
    "civic": Paint("disc", "civic", "paper", 8.0, rank=5, since=0.8),
    "food": Paint("disc", "food", "paper", 8.0, rank=6, since=0.8),
}
"""Paints by name, in the order in which they are laid: the later lies on top."""

CASING = 1.4
"""Casings of roads are this much wider than roads [m]."""
LAYER = {name: layer for layer, name in enumerate(PAINTS)}
CASED = frozenset(name for name, paint in PAINTS.items() if paint.form == "line" and paint.edge)
"""Paints of roads: their edges lie below the surface of all of them, so that junctions are open."""

RULES = {
    AREA: """
water       natural=water waterway=riverbank waterway=dock landuse=reservoir landuse=basin
            leisure=swimming_pool natural=bay water=*
landmark    amenity=place_of_worship amenity=townhall amenity=library amenity=theatre
            amenity=cinema amenity=museum tourism=museum building=church building=cathedral
            building=chapel building=mosque building=synagogue building=temple
            building=train_station building=public historic=castle
building    building=*
pitch       leisure=pitch leisure=track leisure=sports_centre leisure=stadium leisure=playground
park        leisure=park leisure=garden leisure=golf_course leisure=nature_reserve
            leisure=dog_park landuse=village_green landuse=recreation_ground
cemetery    landuse=cemetery amenity=grave_yard
wood        natural=wood landuse=forest natural=scrub
grass       landuse=grass landuse=meadow landuse=flowerbed natural=grassland natural=heath
            barrier=hedge
farm        landuse=farmland landuse=orchard landuse=vineyard landuse=farmyard landuse=allotments
sand        natural=beach natural=sand
rock        natural=bare_rock natural=scree natural=shingle natural=glacier natural=cliff
plaza       place=square highway=* area:highway=* man_made=pier public_transport=platform
            railway=platform man_made=bridge amenity=marketplace
parking     amenity=parking amenity=bicycle_parking amenity=motorcycle_parking
grounds     amenity=* tourism=*
urban       landuse=industrial landuse=commercial landuse=retail landuse=railway
            landuse=construction landuse=brownfield aeroway=*
""",
    LINE: """
motorway    highway=motorway highway=trunk
main-road   highway=primary highway=secondary highway=motorway_link highway=trunk_link
            highway=primary_link highway=secondary_link
promenade   highway=pedestrian
steps       highway=steps
path        highway=footway highway=path highway=cycleway highway=bridleway highway=track
            highway=corridor
service     highway=service highway=raceway highway=construction
street      highway=*
tram        railway=tram railway=light_rail railway=narrow_gauge railway=funicular
            railway=monorail aerialway=*
barrier     railway=abandoned railway=disused railway=subway railway=platform
            public_transport=*
rail        railway=*
shore       natural=coastline
river       waterway=river waterway=canal
stream      waterway=*
barrier     barrier=* natural=* man_made=* power=* leisure=* amenity=* landuse=*
""",
    POINT: """
tree        natural=tree
minor       highway=crossing highway=give_way highway=stop highway=street_lamp
            highway=turning_circle highway=elevator entrance=* barrier=* power=*
            amenity=waste_basket amenity=vending_machine amenity=parking_entrance man_made=*
            natural=* traffic_calming=* emergency=* advertising=*
furniture   amenity=bench amenity=bicycle_parking amenity=recycling amenity=post_box
            amenity=telephone amenity=table amenity=parking amenity=shelter amenity=clock
            amenity=drinking_water amenity=bicycle_rental amenity=charging_station
            amenity=toilets highway=traffic_signals tourism=information
transit     highway=bus_stop railway=* public_transport=* amenity=taxi amenity=bus_station
            amenity=ferry_terminal aeroway=* aerialway=*
food        amenity=restaurant amenity=cafe amenity=fast_food amenity=bar amenity=pub
            amenity=ice_cream amenity=biergarten amenity=food_court
health      amenity=pharmacy amenity=hospital amenity=doctors amenity=dentist amenity=clinic
            amenity=veterinary healthcare=*
shop        shop=* craft=*
leisure     leisure=* amenity=fountain
civic       amenity=* tourism=* historic=* office=* club=* building=* military=* place=*
minor       highway=* waterway=* landuse=* name=*
""",
}
"""By kind of geometry: paints and the labels (or ``key=*``) they get; an indented line goes on."""


@cache
def _rules(kind: int) -> dict[str, tuple[int, str]]:
    """Return the order of the rule and the paint, by label."""
    rules: dict[str, tuple[int, str]] = {}
    paint = ""
    for order, line in enumerate(RULES[kind].splitlines()):
        words = line.split()
        if words and not line.startswith(" "):
            paint = words.pop(0)
        for label in words:
            rules.setdefault(label, (order, paint))
    return rules


def find_paint(labels: Iterable[str], kind: int) -> str:
    """Return the paint of a thing with these labels: that of the first rule, or an empty string."""
    rules = _rules(kind)
    found = [rules.get(label) or rules.get(label.partition("=")[0] + "=*") for label in labels]
    return min(filter(None, found), default=(0, ""))[1]


def style_sheet() -> str:
    """Return CSS variables of the palette, light and dark, chosen by the system or `data-theme`."""
    light, dark = (
        "".join(f"--{name}:{colors[k]};" for name, colors in PALETTE.items()) for k in (0, 1)
    )
    return (
        f":root{{color-scheme:light;{light}}}\n"
        f"@media (prefers-color-scheme:dark){{:root:not([data-theme=light]){{color-scheme:dark;{dark}}}}}\n"
        f":root[data-theme=dark]{{color-scheme:dark;{dark}}}"
    )


def escape_text(text: str) -> str:
    """Escape a text, and drop unprintable characters (controls, changes of direction)."""
    joiners = "\u200c\u200d"
    return escape("".join(c if c.isprintable() or c in joiners else " " for c in text))
