"""Cities to be lost in: drawn in ASCII, given in metres, and real ones."""

import numpy as np
import pytest
from tests.cities import PLANE

from placegraph.maps import open_map
from placegraph.outdoor.city import build_city
from placegraph.outdoor.language.description import Description, Mention, Relation, Sense, Statement
from placegraph.outdoor.likelihood.match_kernels import score_distant, score_exact
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.search.posterior import PRIOR_COHERENT


@pytest.fixture(scope="session")
def monaco_file(shared, tmp_path_factory):
    path = tmp_path_factory.mktemp("monaco") / "monaco.city"
    build_city(shared / "data/osm/monaco_2025.osm.pbf", path)
    return path


@pytest.fixture(scope="session")
def monaco(monaco_file):
    return open_map(monaco_file)


@pytest.fixture(scope="session")
def toronto(shared, tmp_path_factory):
    path = tmp_path_factory.mktemp("toronto") / "toronto.city"
    build_city(shared / "data/osm/toronto_downtown_2020.osm.bz2", path)
    return open_map(path)


@pytest.fixture(params=["monaco", "toronto", "harbour"])
def real_city(request):
    """Each of the two small real cities, and the shipped town."""
    return request.getfixturevalue(request.param)


WINDS = {
    wind: i * np.pi / 4
    for i, wind in enumerate(
        ["north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest"]
    )
}


def _make_description(*statements):
    """Description of statements (source, how, target, options).

    Things are "me", "you", a label such as "shop=bakery", or a name; a "#2" behind tells two of a
    kind apart. `how` is a wind, a bearing [rad] or a relation; options are fields of `Statement`,
    and `count` of the source.
    """
    mentions = {"me": Mention(0, "me"), "you": Mention(1, "you")}
    found = []

    def node(thing, count=None):
        if thing not in mentions:
            what = thing.partition("#")[0]
            label = "=" in what
            mentions[thing] = Mention(
                len(mentions),
                what.partition("=")[2] if label else what,
                (Sense(what, 1.0),) if label else (),
                "" if label else what,
                count,
            )
        return mentions[thing].id

    for source, how, target, *more in statements:
        options = dict(more[0]) if more else {}
        ends = node(source, options.pop("count", None)), node(target)
        if "target2" in options:
            options["target2"] = node(options["target2"])
        direction = how in WINDS or isinstance(how, float)
        relation = Relation.DIRECTION if direction else Relation(how)
        bearing = WINDS.get(how, how) if direction else None
        found.append(Statement(relation, *ends, bearing=bearing, **options))
    return Description("", tuple(mentions.values()), tuple(found))


@pytest.fixture(scope="session")
def make_description():
    """Make a description of statements (source, how, target, options)."""
    return _make_description


def _score(city, description, positions, together=PRIOR_COHERENT):
    """Log-likelihood ratios of a description at positions (K, 2) [m], as a closer look sees them."""
    query = compile_query(description, city)
    words = query.token_weights(len(city.objects.labels) + len(city.objects.names))
    views, found = city.views, []
    for position in np.atleast_2d(np.asarray(positions, np.float64)):
        at = position[None]
        far = np.zeros((1, len(query.used)), np.float32)
        if query.distant is not None:
            far = score_distant(
                query.statements, city.columns, query.distant, at.astype(np.float32)
            )
        nearby = np.unique(city.in_sight(views.near(position, REACH)).objects)
        seen = np.array([0, len(nearby)]), nearby
        found.append(
            score_exact(
                query.statements, city.columns, words, at[None], seen, far[None], together, True
            )
        )
    return tuple(np.concatenate([c[0] for c in column]) for column in zip(*found, strict=True))


@pytest.fixture(scope="session")
def score():
    """Score a description at positions: totals (K,), of each statement (K, S), served (K, S, 2)."""
    return _score


@pytest.fixture
def at():
    """East and north on a city's own plane of east and north around 10 E, 50 N [m]."""
    return lambda city, east_north: city.plane.to_plane(PLANE.to_lonlat(east_north))
