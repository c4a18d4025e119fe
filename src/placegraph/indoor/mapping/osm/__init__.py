"""OpenStreetMap's rooms as rough scene maps, and scene maps as OpenStreetMap's rooms."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from placegraph.errors import OptionError
from placegraph.formats.place.indoor_osm import read_indoor_osm
from placegraph.formats.place.levels import levels_of
from placegraph.indoor.mapping.from_capture import Source
from placegraph.indoor.mapping.osm.model import model_of
from placegraph.indoor.mapping.osm.rooms import level_of

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Mapping
    from pathlib import Path


def rooms_source(path: Path, options: Mapping[str, Any], left_out: Counter[str]) -> Source:
    """Source of a scene map of one level of an OpenStreetMap file, `options["level"]`.

    Raises `InputError` and `OptionError` as `read_indoor_osm` and `level_of` do.
    """
    if strange := set(options) - {"level"}:
        raise OptionError(
            f"{', '.join(sorted(strange))}: no option of OpenStreetMap's rooms; it has level."
        )
    given = options.get("level")
    wanted = (
        None
        if given is None
        else levels_of(f"{given:g}" if isinstance(given, float) else str(given))
    )
    if wanted is not None and len(wanted) != 1:
        raise OptionError(f"level is {given!r}; give one, as 1 or -1 or 0.5.")
    plan = read_indoor_osm(path)
    level = level_of(plan, wanted[0] if wanted else None)
    model = model_of(level, path, plan.left_out)
    left_out.update(plan.left_out)
    return Source(model, notes=level.notes, anchors=(level.anchor,))
