"""Drawings of maps for the page: tiles of a city, plans of scenes, and the files that pages share."""

from __future__ import annotations

import gzip
import itertools
import json
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from fastapi import APIRouter, Request, Response
from fastapi.staticfiles import StaticFiles

from placegraph import view
from placegraph.errors import RequestError
from placegraph.view.city.page import TOP_LEVEL, CityTiles
from placegraph.view.draw.style import style_sheet
from placegraph.view.scene.page import describe_plan, draw_png, open_plan
from placegraph_serve.places import Places, state_of

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

PAGE = Path(__file__).parent / "page"
PARTS = Path(view.__file__).parent / "page"
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; manifest-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing of a page comes from elsewhere."""
CACHE_BYTES = 64_000_000
"""Tiles are kept, those asked for last, up to so much."""
_CLIENT_CACHE = {"Cache-Control": "private, max-age=60"}
FARTHEST = 1 << 20
"""Columns and rows of tiles lie within this."""


class AnswerCache:
    """Cache of answers, each made once, up to a number of bytes."""

    def __init__(self, most: int) -> None:
        self.most, self.size = most, 0
        self._known: OrderedDict[tuple[Any, ...], bytes] = OrderedDict()
        self._lock = threading.Lock()
        self._making = threading.Lock()

    def get(self, key: tuple[Any, ...], make: Callable[[], bytes]) -> bytes:
        """Return the cached value of a key, or make it; one is made at a time."""
        found = self._find(key)
        if found is not None:
            return found
        with self._making:
            found = self._find(key)  # others may have waited for the same
            return self._keep(key, make()) if found is None else found

    def _find(self, key: tuple[Any, ...]) -> bytes | None:
        with self._lock:
            if key in self._known:
                self._known.move_to_end(key)
            return self._known.get(key)

    def _keep(self, key: tuple[Any, ...], made: bytes) -> bytes:
        with self._lock:
            self._known[key] = made
            self.size += len(made)
            while self.size > self.most and len(self._known) > 1:
                self.size -= len(self._known.popitem(last=False)[1])
        return made


def drawing_router(places: Places) -> APIRouter:
    """Routes that draw some maps."""
    router = APIRouter()
    cached = AnswerCache(CACHE_BYTES)
    cities: WeakKeyDictionary[CityMap, tuple[int, CityTiles]] = WeakKeyDictionary()
    numbers = itertools.count()

    def tiles_of(name: str) -> tuple[int, CityTiles]:
        """Tiles of a city as its file is now, and a number that no other has."""
        city = places.city(name)
        if city not in cities:
            cities[city] = next(numbers), CityTiles(city)
        return cities[city]

    @router.get("/v1/maps/{name}/drawing")
    def index(name: str, request: Request, scene: str = "") -> Response:
        """Describe a map for a page, before it asks for tiles or the picture of a scene.

        Of a city plane, bounds, levels and paints, see `placegraph.view.city.page`; of a scene its
        bounds and things, see `placegraph.view.scene.page`.
        """
        entry = places.entry(name)
        if entry.kind == "city":
            number, tiles = tiles_of(name)
            return _packed(request, cached.get((number,), lambda: _bytes(tiles.index())))
        key = name, scene, state_of(entry.path)
        made = cached.get(key, lambda: _bytes(describe_plan(open_plan(places.scene(name), scene))))
        return _packed(request, made)

    @router.get("/v1/maps/{name}/drawing.png")
    def floor(name: str, scene: str = "", *, dark: bool = False) -> Response:
        """Picture of a scene from above, of just its bounds, to be laid on a map."""
        key = name, scene, dark, state_of(places.entry(name).path)
        made = cached.get(key, lambda: draw_png(open_plan(places.scene(name), scene), dark=dark))
        return Response(made, media_type="image/png", headers=_CLIENT_CACHE)

    @router.get("/v1/maps/{name}/drawing/{level}/{x}/{y}")
    def tile(name: str, level: int, x: int, y: int, request: Request) -> Response:
        """One tile of a city, see `placegraph.view.city.page`."""
        number, tiles = tiles_of(name)
        if not (0 <= level <= TOP_LEVEL and abs(x) < FARTHEST and abs(y) < FARTHEST):
            raise RequestError(
                f"Tile {level}/{x}/{y} lies outside all cities; levels are 0 to {tiles.top}.",
                status=404,
                code="tile_unknown",
            )
        made = cached.get((number, level, x, y), lambda: _bytes(tiles.tile(level, x, y)))
        return _packed(request, made)

    @router.get("/parts/palette.css", include_in_schema=False)
    def palette() -> Response:
        """Colours of pages and maps."""
        return Response(style_sheet(), media_type="text/css")

    return router


def _bytes(data: object) -> bytes:
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"))
    return gzip.compress(text.encode(), 5, mtime=0)


def _packed(request: Request, packed: bytes) -> Response:
    """Compressed JSON, as the client takes it; it may keep it for a while."""
    headers = _CLIENT_CACHE | {"Vary": "Accept-Encoding"}
    if "gzip" in request.headers.get("accept-encoding", ""):
        headers["Content-Encoding"] = "gzip"
    else:
        packed = gzip.decompress(packed)
    return Response(packed, media_type="application/json", headers=headers)


class Files(StaticFiles):
    """Files of the page, which loads nothing from elsewhere and stands in no frame."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:  # noqa: ANN401
        """The file, with the page's policy."""
        response = super().file_response(*args, **kwargs)
        response.headers["Content-Security-Policy"] = POLICY
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cache-Control"] = "no-cache"
        return response


def page_files() -> dict[str, StaticFiles]:
    """Return the folders of the files of the page by path."""
    return {"/parts": Files(directory=PARTS), "/": Files(directory=PAGE, html=True)}
