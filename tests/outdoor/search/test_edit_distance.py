import itertools
import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.graph import SceneGraph
from placegraph.errors import DescriptionError, MissingExtraError, OptionError
from placegraph.outdoor.language.description import (
    SPEAKER,
    Description,
    Mention,
    Relation,
    Sense,
    Statement,
)
from placegraph.outdoor.map.directions_kernels import name_direction
from placegraph.outdoor.search.edit_distance import (
    PLAIN,
    TIMEOUT,
    Costs,
    Distance,
    Edge,
    LabelledGraph,
    Node,
    distance,
    rank,
)

LONG = 30.0
BEARING = {"north": 0.0, "east": 0.5 * math.pi, "south": math.pi, "west": 1.5 * math.pi}


def edit_distance(description, graph, *, center=None, timeout=TIMEOUT, plain=False):
    """Distance from a text's graph to one cell's."""
    centers = None if center is None else [center]
    ranked = rank(description, [graph], centers=centers, timeout=timeout, plain=plain)
    return Distance(float(ranked.costs[0]), bool(ranked.exact[0]))


def place(*things, names=(), extra=()):
    """Scene graph of (label, east, north) with the relation of Eq. 6 between any two."""
    at = np.array([(e, n) for _, e, n in things], np.float64).reshape(-1, 2)
    edges = [
        (a, b, name_direction(at[a] - at[b]))
        for a, b in itertools.permutations(range(len(things)), 2)
    ]
    edges += extra
    sources, targets, relations = zip(*edges, strict=True) if edges else ((), (), ())
    return SceneGraph(
        ids=tuple(map(str, range(len(things)))),
        labels=tuple(label for label, _, _ in things),
        names=names,
        positions=at,
        sources=np.array(sources, np.int64),
        targets=np.array(targets, np.int64),
        relations=relations,
    )


def make_description(mentions, statements):
    """Mentions as a label, (label, weight) pairs, or a `Mention`; statements as their fields."""
    nodes = [Mention(0, "I"), Mention(1, "you")]
    for i, m in enumerate(mentions, 2):
        senses = [(m, 1.0)] if isinstance(m, str) else m
        if not isinstance(m, Mention):
            m = Mention(i, "x", tuple(Sense(*s) for s in senses))  # noqa: PLW2901
        nodes.append(m)
    return Description("", tuple(nodes), tuple(Statement(*s) for s in statements))


def toward(source, direction, target):
    return (Relation.DIRECTION, source, target, None, BEARING[direction])


BAKERY, CHURCH, BENCH = "shop=bakery", "building=church", "amenity=bench"
SQUARE = place((BAKERY, 0, 10), (CHURCH, 0, 0), (BENCH, 20, 0))
TEXT = make_description([BAKERY, CHURCH], [toward(2, "north", 3)])


@pytest.mark.parametrize(
    ("mentions", "statements", "cost"),
    [
        ([BAKERY, CHURCH], [toward(2, "north", 3)], 0.0),
        ([BAKERY, CHURCH], [toward(2, "south", 3)], 1.0),  # the relation is deleted
        ([BAKERY, "shop=books"], [toward(2, "north", 3)], 2.0),  # the bookshop and its relation
        ([BAKERY, CHURCH, BENCH], [toward(2, "north", 3), toward(4, "east", 3)], 0.0),
        ([BAKERY, CHURCH, BENCH], [toward(2, "north", 3), toward(3, "east", 4)], 1.0),
        ([[(BAKERY, 0.7), ("shop=cake", 1.0)], CHURCH], [toward(2, "north", 3)], 0.3),
        ([[("shop=*", 0.9)], CHURCH], [toward(2, "north", 3)], 0.1),
        ([BAKERY, BAKERY], [toward(2, "north", 3)], 2.0),  # one bakery cannot be two
    ],
)
def test_costs_by_hand(mentions, statements, cost):
    found = edit_distance(make_description(mentions, statements), SQUARE)
    assert found.cost == pytest.approx(cost)
    assert found.exact


def test_names_are_names():
    def named(name, *senses):
        return make_description([Mention(2, "x", tuple(Sense(s, 1.0) for s in senses), name), CHURCH],
                    [toward(2, "north", 3)])  # fmt: skip

    town = place((BAKERY, 0, 10), (CHURCH, 0, 0), names=("Bäckerei Kern", ""))
    assert edit_distance(named("bäckerei kern"), town).cost == 0.0
    assert edit_distance(named("Backhaus", BAKERY), town).cost == 2.0  # another bakery
    nameless = place((BAKERY, 0, 10), (CHURCH, 0, 0))
    assert edit_distance(named("Backhaus", BAKERY), nameless).cost == pytest.approx(0.6)


def test_near_and_inside_are_relations_too():
    near = make_description([BENCH, CHURCH], [(Relation.NEAR, 2, 3), toward(2, "east", 3)])
    assert edit_distance(near, SQUARE).cost == 1.0
    touching = place((BENCH, 5, 0), (CHURCH, 0, 0), extra=[(0, 1, "near")])
    assert edit_distance(near, touching).cost == 0.0


def test_a_direction_between_two_is_served_by_either():
    diagonal = (Relation.DIRECTION, 2, 3, None, 0.25 * math.pi)
    for east, north, cost in ((9, 1, 0.0), (1, 9, 0.0), (-9, 1, 1.0)):
        town = place((BAKERY, east, north), (CHURCH, 0, 0))
        assert edit_distance(make_description([BAKERY, CHURCH], [diagonal]), town).cost == cost


def test_the_speaker_stands_in_the_middle():
    text = make_description(
        [BAKERY, BENCH], [toward(2, "north", SPEAKER), toward(SPEAKER, "west", 3)]
    )
    assert edit_distance(text, SQUARE, center=(0.0, 2.0)).cost == 0.0
    assert edit_distance(text, SQUARE, center=(30.0, 0.0)).cost == 2.0
    assert edit_distance(text, SQUARE).cost == 0.0  # unknown: only the things count


def test_what_is_denied_does_not_count():
    no_tree = Statement(Relation.VISIBLE, 4, SPEAKER, negated=True)
    text = make_description([BAKERY, CHURCH, "natural=tree"], [toward(2, "north", 3)])
    text = Description("", text.mentions, (*text.statements, no_tree))
    assert edit_distance(text, SQUARE).cost == 0.0


def test_ranking_is_by_distance_and_stable():
    empty, mirrored = place((BENCH, 0, 0)), place((BAKERY, 0, -10), (CHURCH, 0, 0))
    ranked = rank(TEXT, [empty, mirrored, SQUARE, empty, SQUARE])
    assert ranked.rows.tolist() == [2, 4, 1, 0, 3]
    assert ranked.costs.tolist() == [0.0, 0.0, 1.0, 3.0, 3.0]
    assert ranked.exact.all()
    assert len(rank(TEXT, []).rows) == 0


labels = st.sampled_from([BAKERY, CHURCH, BENCH])
points = st.tuples(labels, st.integers(-20, 20), st.integers(-20, 20))
places = st.lists(points, min_size=0, max_size=4, unique_by=lambda p: p[1:]).map(
    lambda things: place(*things)
)
relations = st.frozensets(st.sampled_from([*BEARING, "near"]), min_size=1, max_size=2)


@st.composite
def texts(draw):
    senses = st.dictionaries(labels, st.sampled_from([0.3, 0.8, 1.0]), max_size=2)
    nodes = draw(st.lists(senses.map(Node), min_size=1, max_size=3))
    pairs = st.sampled_from([*itertools.permutations(range(len(nodes)), 2)] or [None])
    edges = draw(st.lists(st.tuples(pairs, relations), max_size=4, unique=True))
    return LabelledGraph(tuple(nodes), tuple(Edge(*p, r) for p, r in edges if p))


def brute_force(first, second, costs):
    """Cheapest of all assignments, and of all ways to pair the edges that they bring together."""
    best = math.inf
    n = len(second.nodes)
    for choice in itertools.product([None, *range(n)], repeat=len(first.nodes)):
        used = [u for u in choice if u is not None]
        if len(set(used)) < len(used):
            continue
        cost = (n - len(used)) * costs.node_insertion
        for a, u in enumerate(choice):
            if u is None:
                cost += 1.0
                continue
            fits = max((second.nodes[u].labels.get(x, 0.0) * w for x, w in
                        first.nodes[a].labels.items()), default=0.0)  # fmt: skip
            if math.isinf(costs.mismatch):
                cost += 1.0 - fits if fits else math.inf
            else:
                cost += 0.0 if fits == 1.0 else costs.mismatch
        best = min(best, cost + edges(first.edges, second.edges, choice, costs))
    return best


def edges(text, cell, choice, costs):
    if not text:
        return len(cell) * costs.edge_insertion
    first, rest = text[0], text[1:]
    best = 1.0 + edges(rest, cell, choice, costs)
    for i, c in enumerate(cell):
        if (choice[first.source], choice[first.target]) == (c.source, c.target):
            others = [*cell[:i], *cell[i + 1 :]]
            wrong = float(not first.relations & c.relations)
            best = min(best, wrong + edges(rest, others, choice, costs))
    return best


@settings(max_examples=60, deadline=None)
@given(texts(), places, st.sampled_from([Costs(), Costs(node_insertion=0.1), PLAIN]))
def test_distances_are_the_cheapest_edits(text, where, costs):
    cell = LabelledGraph.of_scene_graph(where)
    found = distance(text, cell, costs=costs, timeout=LONG)
    assert found.exact
    assert found.cost == pytest.approx(brute_force(text, cell, costs))


@settings(max_examples=30, deadline=None)
@given(places, places)
def test_the_plain_distance_is_symmetric_and_zero_for_equals(a, b):
    first, second = map(LabelledGraph.of_scene_graph, (a, b))
    there = distance(first, second, costs=PLAIN, timeout=LONG)
    back = distance(second, first, costs=PLAIN, timeout=LONG)
    assert there.cost == back.cost
    shuffled = LabelledGraph.of_scene_graph(a.subgraph(np.arange(len(a))[::-1]))
    assert distance(first, shuffled, costs=PLAIN, timeout=LONG).cost == 0.0


@settings(max_examples=20, deadline=None)
@given(texts(), places)
def test_when_time_is_up_the_bound_is_returned(text, where):
    cell = LabelledGraph.of_scene_graph(where)
    for costs in (Costs(), PLAIN):
        exact = distance(text, cell, costs=costs, timeout=LONG)
        hasty = distance(text, cell, costs=costs, timeout=1e-9)
        assert exact.cost - 1e-9 <= hasty.cost
        if hasty.exact:
            assert hasty.cost == pytest.approx(exact.cost)
        everything = len(text.nodes) + len(text.edges)
        everything += len(cell.nodes) * costs.node_insertion
        assert hasty.cost <= everything + len(cell.edges) * costs.edge_insertion + 1e-9


def test_a_crowd_is_bounded_in_time():
    crowd = place(*((BENCH, 7 * i % 61, i) for i in range(60)))
    text = make_description([BENCH] * 5, [toward(i, "north", i + 1) for i in range(2, 6)])
    hasty = edit_distance(text, crowd, timeout=0.01)
    assert 0.0 <= hasty.cost < 9.0  # the truth is 0; deleting all of the text is 9
    assert hasty.exact == (hasty.cost == 0.0)
    plain = edit_distance(text, crowd, timeout=0.01, plain=True)
    assert not plain.exact
    assert plain.cost >= 55.0 + 60 * 59 - 4


def test_bad_options_are_refused():
    for timeout in (0.0, -1.0, math.nan, "soon"):
        with pytest.raises(OptionError, match="timeout"):
            edit_distance(TEXT, SQUARE, timeout=timeout)
    with pytest.raises(OptionError, match="centers have shape"):
        edit_distance(TEXT, SQUARE, center=(1.0,))
    with pytest.raises(OptionError, match="centers"):
        rank(TEXT, [SQUARE], centers=[(0.0, 0.0), (1.0, 1.0)])
    with pytest.raises(DescriptionError, match="no object"):
        edit_distance(make_description([], []), SQUARE)


def test_networkx_is_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    with pytest.raises(MissingExtraError, match="networkx"):
        edit_distance(TEXT, SQUARE)
