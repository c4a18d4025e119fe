"""A place's name and outline, from Nominatim by OSMnx, which knows the server and its limits."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from placegraph.errors import InputError
from placegraph.io.osm.services import accept, agent, nonsense, unreachable

PAD = 0.001
"""A place is fetched with its surroundings, this wide [deg]: from its edge one sees beyond it."""
PARTS, CORNERS = 16, 600
"""An outline is coarsened until it has no more parts and corners than these."""
METRES_A_DEGREE = 111_320.0


def find(ox: Any, place: str) -> tuple[str, Any]:  # noqa: ANN401 - osmnx and shapely, loaded late
    """Full name of a place and its outline, a polygon or several, longitude/latitude.

    Raises `InputError` where it is unknown, has no outline or is too large, `ServiceError` where
    Nominatim does not say.
    """
    import requests

    shapes: list[str] = []  # of all places of this name

    def hear(response: requests.Response, **_: object) -> None:
        """Stop at a failure: OSMnx itself asks a busy server for ever, and reads errors as data."""
        if response.is_redirect:
            return
        accept(response, "Nominatim")
        try:
            shapes.extend(str.strip(found["geojson"]["type"]) for found in response.json())
        except (LookupError, TypeError, ValueError, RecursionError) as error:
            raise nonsense("Nominatim", response.content[:4096]) from error

    hooks = ox.settings.requests_kwargs | {"hooks": {"response": hear}}
    try:
        with _settings(ox, use_cache=False, requests_kwargs=hooks, http_user_agent=agent(ox)):
            found = ox.geocode_to_gdf(place)
        name, outline = str(found["display_name"].iloc[0]), found.geometry.iloc[0]
    except requests.RequestException as error:
        raise unreachable("Nominatim", error) from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        if not shapes:
            raise InputError(
                f"No place is called {place!r}; check the spelling, or add the region or country."
            ) from error
        if not {"Polygon", "MultiPolygon"} & set(shapes):
            raise InputError(
                f"{place!r} is known as a point or line only; name a town or district that has an "
                "outline, or download an extract for `placegraph city build`."
            ) from error
        raise nonsense("Nominatim", repr(error).encode()) from error
    if outline.is_empty:
        raise nonsense("Nominatim", b"an outline of nothing")
    area = outline.area * METRES_A_DEGREE**2 * math.cos(math.radians(outline.centroid.y))
    if not area <= ox.settings.max_query_area_size:
        raise InputError(
            f"{name!r} covers {area / 1e6:,.0f} km2, which is too much for Overpass (limit: "
            f"{ox.settings.max_query_area_size / 1e6:,.0f} km2). Name a part of it, or download an "
            "extract for `placegraph city build`."
        )
    return name, outline


@contextmanager
def _settings(ox: Any, **changes: object) -> Iterator[None]:  # noqa: ANN401 - the module osmnx
    """Change settings of OSMnx for a while: they are global, and the user's."""
    before = {name: getattr(ox.settings, name) for name in changes}
    try:
        for name, value in changes.items():
            setattr(ox.settings, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(ox.settings, name, value)


def rings(outline: Any) -> list[str]:  # noqa: ANN401 - shapely's geometry, untyped
    """Rings around a place, as Overpass's polygon filter wants them: "lat lon lat lon ..."."""
    pad = PAD
    while True:  # widened by twice what the simplification may cut off
        wide = outline.buffer(pad).simplify(pad / 2)
        rings = [np.array(part.exterior.coords) for part in getattr(wide, "geoms", [wide])]
        if len(rings) <= PARTS and sum(map(len, rings)) <= CORNERS:
            earth = [np.clip(ring, (-180, -90), (180, 90)) for ring in rings]
            return [" ".join(f"{y:.5f} {x:.5f}" for x, y in ring) for ring in earth]
        pad *= 2
