"""City maps that can be asked where a sentence was spoken, and their build from an extract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

from numpy.typing import NDArray

from placegraph.core.files import resolve_path
from placegraph.core.options import reject_unknown
from placegraph.core.pickling import HtmlRepr
from placegraph.errors import OptionError
from placegraph.io.osm.urls import fetch_temporarily, file_name, is_url
from placegraph.outdoor.map.city import City
from placegraph.outdoor.options import CellOptions

if TYPE_CHECKING:
    import geopandas as gpd
    import numpy as np

    from placegraph.core.estimate import CityEstimate
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.language.vocabulary import Vocabulary
    from placegraph.outdoor.map.extract import Overture, Progress
    from placegraph.outdoor.network.network import EncodedCity
    from placegraph.outdoor.search.ask import Answer, Question
    from placegraph.outdoor.search.request import MatchingOptions
    from placegraph.outdoor.track.tracker import CityTracker


class CityMap(HtmlRepr, City):
    """A city that can be asked.

    Made by `build_city`, opened by `open_map`; never changed by localizing in it.
    """

    @cached_property
    def encoded(self) -> EncodedCity:
        """The city as the shipped network reads it; derived on first use."""
        from placegraph.outdoor.network.network import EncodedCity

        return EncodedCity.of_city(self)

    @cached_property
    def encoded_as_printed(self) -> EncodedCity:
        """The city as the network that the paper prints reads it; derived on first use."""
        from placegraph.outdoor.network.network import EncodedCity

        return EncodedCity.of_city(self, printed=True)

    @property
    def embeddings(self) -> NDArray[np.float32]:
        """Embeddings (C, D) of all cells by the shipped network (Eq. 10)."""
        return self.encoded.embeddings

    def locate(
        self,
        text: str | Description,
        *,
        top: int = 5,
        near: Sequence[float] | None = None,
        radius: float = 1000.0,
        heading: float | None = None,
        listener: Sequence[float] | None = None,
        answers: Sequence[Answer] = (),
        **matching: Unpack[MatchingOptions],
    ) -> CityEstimate:
        """Locate where a description was spoken.

        Parameters
        ----------
        text
            What stands around the speaker, in words (or an already parsed description).
        top
            How many modes at most.
        near
            Longitude and latitude [deg] the speaker is known to be near; a third number is the
            radius [m].
        radius
            Radius of `near` [m]: a Gaussian prior of which half lies within.
        heading
            Where the speaker looks [rad], clockwise from north: gives "left of me" a meaning.
        listener
            Longitude and latitude [deg] of "you", where that is known; a told way begins there.
        answers
            Answers to earlier questions of `CityEstimate.next_question`.
        matching
            `language` of the text ("de"), told from its words where not given; `preset`
            (`Matching.preset`), and what overrides it: `matcher`, `score`, `by`,
            `candidates`, `store`, `region`, `printed`, `encoded`; see `Matching`.

        Returns
        -------
        CityEstimate
            Ranked modes with probability over the whole city, and the evidence.

        Raises
        ------
        DescriptionError
            The text is empty, too long, or not text.
        OptionError
            An option is unknown or out of range.
        StoreError
            The store is of another map or another network.

        """
        from placegraph.outdoor.search.locate import locate
        from placegraph.outdoor.search.request import Hints, Matching, MatchingOptions, is_count
        from placegraph.outdoor.track.route_answer import locate_route, read_instructions

        known = {"top", *Hints.__annotations__, *MatchingOptions.__annotations__}
        reject_unknown(matching, known, "CityMap.locate")
        language = matching.pop("language", None)
        if not is_count(top):
            raise OptionError(f"top is {top!r}; give at least 1.")
        hints = Hints(near, radius, heading, listener, answers, language)
        chosen = Matching.preset(matching.pop("preset", "default"), **matching)
        if chosen.uses_network and chosen.encoded is None:
            encoded = self.encoded_as_printed if chosen.printed else self.encoded
            chosen = replace(chosen, encoded=encoded)
        if (
            isinstance(text, str)
            and not chosen.ranks_cells
            and (steps := read_instructions(text, self))
        ):
            return locate_route(self, text, steps, hints=hints, matching=chosen, top=top)
        return locate(self, text, top=top, hints=hints, matching=chosen)

    def track(
        self,
        *,
        near: Sequence[float] | None = None,
        radius: float = 1000.0,
        heading: float | None = None,
        top: int = 5,
    ) -> CityTracker:
        """Follow somebody who speaks and walks; see `CityTracker`, arguments as for `locate`."""
        from placegraph.outdoor.track.tracker import CityTracker

        return CityTracker(self, near=near, radius=radius, heading=heading, top=top)

    def to_geojson(self, what: Literal["objects", "cells"] = "objects") -> dict[str, Any]:
        """The map as a GeoJSON FeatureCollection, longitude and latitude to a centimetre.

        ``objects`` have properties `osm` ("way/1"), `label`, `name` and `tags`, as far as the map
        holds them, and shapes as coarse as the map's; ``cells`` are squares with property `cell`.
        Raises `OptionError` where it is neither.
        """
        from placegraph.outdoor.map.city import make_geojson

        return make_geojson(self, what)

    def to_geopandas(self, what: Literal["objects", "cells"] = "objects") -> gpd.GeoDataFrame:
        """`to_geojson` as a table in WGS84; raises `MissingExtraError` without GeoPandas."""
        from placegraph.core.geojson import to_geopandas

        return to_geopandas(self.to_geojson(what))

    def ask(self, estimate: CityEstimate) -> Question | None:
        """Question whose answer is expected to tell the modes apart best; None where none would."""
        from placegraph.outdoor.search.ask import next_question

        return next_question(estimate, self)


def build_city(
    osm_path: str | PathLike[str] | Overture,
    out_path: str | PathLike[str],
    *,
    cell_size: float = 50.0,
    stride: float | None = None,
    edge_distance: float | None = None,
    vocabulary: Vocabulary | None = None,
    index: bool | None = None,
    progress: Progress | None = None,
) -> CityMap:
    """Build a city map from an OpenStreetMap extract, or from Overture, and write it to `out_path`.

    Parameters
    ----------
    osm_path
        `.osm.pbf`, `.osm`, `.osm.gz` or `.osm.bz2`, or a URL of one, which is fetched beside `out_path`
        until it is read; or `Overture`: files and a box.
    out_path
        Map file to write (atomically; an old one is replaced only by a whole new one).
    cell_size
        Edge of a cell [m].
    stride
        Distance of neighbouring cells' centres [m]; the cell size where not given.
    edge_distance
        Objects of a cell nearer than this are joined by an edge [m]; the cell size where not given.
    vocabulary
        Which tags are worth naming; the shipped one where not given.
    index
        Whether the file holds the index of viewpoints, which makes it ten times as large and the first
        question quick; where not given, that of a large map does.
    progress
        Is told how far the build is.

    Raises
    ------
    InputError
        The file cannot be read, or holds nothing worth naming.
    OptionError
        A size is not positive; `out_path` is a URL.
    MapError
        `out_path` cannot be written, or is no file name.
    MissingExtraError, ServiceError
        What a URL takes is not installed; or its server does not answer.
    MapLockedError
        Somebody else is writing the same map.

    """
    if is_url(out_path):
        raise OptionError(f"{out_path} is a URL; name a file of this machine.")
    paths = (osm_path,) if isinstance(osm_path, str | PathLike) else osm_path.paths
    for path in paths:
        if resolve_path(path) == resolve_path(out_path):
            raise OptionError(
                f"{path} is the input and would be overwritten by the map; choose another "
                "output file."
            )
    edge, step, reach = CellOptions(cell_size, stride, edge_distance).sizes
    from placegraph.outdoor.map.extract import read_extract

    fetching = None if progress is None else lambda step, n, _total: progress(step, n)
    with fetch_temporarily(osm_path, Path(out_path), fetching) as path:
        plane, objects, left_out = read_extract(path, vocabulary, progress)
    city = CityMap.create(
        plane, objects, cell_size=edge, stride=step, edge_distance=reach,
        source=", ".join(map(file_name, paths)), left_out=left_out,
    )  # fmt: skip
    city.save(out_path, index=index)
    return city
