from dataclasses import replace
from functools import partial
from typing import get_args

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import OptionError, StoreError
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.network.network import EncodedCity
from placegraph.outdoor.options import By, Matcher
from placegraph.outdoor.search import cells, posterior
from placegraph.outdoor.search.edit_distance import rank
from placegraph.outdoor.search.posterior import (
    compute_posterior,
    find_candidate_cells,
    find_candidates,
    find_dense_cells,
    find_views_in_cells,
    score_candidates,
)
from placegraph.outdoor.search.request import Matching, Request, find_in_region, parse
from placegraph.vectors import Neighbours, Origin, Region

MATCHERS, WAYS = get_args(Matcher), get_args(By)
BENCH, TREE, FOUNTAIN = "amenity=bench", "natural=tree", "amenity=fountain"


@pytest.fixture(scope="module")
def text(make_description):
    return make_description(
        (FOUNTAIN, "north", "me"), ("me", "inside", "place=square"), (BENCH, "near", FOUNTAIN)
    )


@pytest.fixture(scope="module")
def query(text, harbour):
    return compile_query(text, harbour)


def retrieve(city, text, *, top=5, timeout=0.1, **options):
    """Rank ten candidates of both ways, if nothing else is asked for."""
    matching = Matching(**{"by": "both", "candidates": 10} | options)
    return cells.retrieve(city, text, matching, top=top, timeout=timeout)


def asking(city, query, n, by, encoded, **options):
    return Request(city, query, matching=Matching(by=by, candidates=n, encoded=encoded, **options))


def whole(city):
    west, south = city.plane.to_lonlat(city.objects.points.min(axis=0) - 100.0)
    east, north = city.plane.to_lonlat(city.objects.points.max(axis=0) + 100.0)
    return float(west), float(south), float(east), float(north)


@pytest.mark.parametrize("matcher", MATCHERS)
@pytest.mark.parametrize("by", WAYS)
def test_every_matcher_ranks_the_cells_of_every_way(matcher, by, harbour, encoded, text):
    if matcher.startswith("edit-distance") and by == "all":
        pytest.skip("edit distance of all cells takes seconds")
    found = retrieve(
        harbour, text, matcher=matcher, by=by, candidates=6, top=4, encoded=encoded, timeout=0.01
    )
    assert len(found.cells) == len(found.rows) == len(found.scores) == 4
    assert len(set(found.cells)) == 4
    assert (np.diff(found.scores) <= 0).all()
    assert found.cells == tuple(harbour.cells.id_of(row) for row in found.rows)
    if by != "all":
        query = compile_query(text, harbour)
        assert set(found.rows) <= set(
            find_candidate_cells(asking(harbour, query, 6, by, encoded)).tolist()
        )


def test_relational_matching_finds_the_place(harbour, encoded, text):
    found = retrieve(harbour, text, matcher="relational", by="sparse", top=1, encoded=encoded)
    fountains = [i for i in range(len(harbour.objects)) if harbour.objects.label(i) == FOUNTAIN]
    at = harbour.cells.center(found.cells[0])
    delta = harbour.objects.center[fountains] - at
    assert np.hypot(*delta.T).min() < 50.0


def test_overlapping_cells_share_their_viewpoints(harbour, encoded, text):
    wide = replace(harbour, cells=replace(harbour.cells, size=3.0 * harbour.cells.grid.stride))
    everything = EncodedCity(wide, encoded.network)
    best = retrieve(wide, text, matcher="relational", by="all", top=9, encoded=everything)
    assert best.scores == pytest.approx(best.scores[0])


def test_the_transformer_and_the_embedding_are_those_of_the_network(harbour, encoded, text, query):
    found = retrieve(harbour, text, matcher="transformer", by="all", top=9, encoded=encoded)
    match = encoded.match(encoded.text(query), encoded.cells, found.rows)
    assert found.scores == pytest.approx(match.logit, rel=1e-4, abs=1e-4)
    found = retrieve(harbour, text, matcher="embedding", by="all", top=9, encoded=encoded)
    vector = encoded.network.embed_texts(encoded.text(query).graphs)[0]
    similarity = encoded.embeddings @ vector
    assert found.rows.tolist() == np.argsort(-similarity, kind="stable")[:9].tolist()
    # candidates by embeddings, ranked by embeddings, are the nearest of all
    dense = retrieve(
        harbour, text, matcher="embedding", by="dense", candidates=9, top=9, encoded=encoded
    )
    assert set(dense.rows.tolist()) == set(found.rows.tolist())


def test_both_takes_turns(harbour, encoded, query):
    dense, sparse, both = (
        find_candidate_cells(asking(harbour, query, 8, by, encoded)).tolist()
        for by in ("dense", "sparse", "both")
    )
    assert len(dense) == 8
    assert len(both) == len(set(both)) == 8
    assert both[:2] == [dense[0], sparse[0]] or dense[0] == sparse[0]
    turns = [row for pair in zip(dense, sparse, strict=False) for row in pair]
    assert both == list(dict.fromkeys(turns))[:8]


def test_a_store_of_ones_own_is_asked(harbour, encoded, query):
    class Store:
        def __init__(self):
            self.asked = []

        def search(self, queries, n, region=None):
            self.asked.append((queries, n, region))
            ids = np.full((1, n), -1, np.int64)
            ids[0, :2] = harbour.cells.points[[5, 3]]
            return Neighbours(ids, np.zeros((1, n), np.float32))

    store, region = Store(), Region(*whole(harbour))
    rows = find_dense_cells(
        asking(harbour, query, 9, "dense", encoded, store=store, region=region), 4
    )
    assert rows.tolist() == [5, 3]
    ((vectors, n, asked),) = store.asked
    assert vectors.shape == (1, encoded.network.shape.dimension)
    assert (n, asked) == (4, region)


def test_views_in_cells_are_those_that_lie_there(harbour):
    rows = np.array([7, 40])
    views = find_views_in_cells(harbour, rows)
    assert (np.diff(views) > 0).all()
    delta = np.abs(harbour.views.positions[:, None] - harbour.cells.centers(rows)[None]).max(axis=2)
    assert views.tolist() == np.flatnonzero((delta <= harbour.cells.size / 2).any(axis=1)).tolist()
    assert find_views_in_cells(harbour, rows[:0]).shape == (0,)


def test_what_is_only_absent_finds_nothing(harbour, encoded, make_description):
    text = make_description((TREE, "near", "me", {"negated": True}))
    assert retrieve(harbour, text, by="sparse", encoded=encoded).cells == ()
    dense = retrieve(harbour, text, by="dense", matcher="relational", encoded=encoded)
    assert (dense.scores == -1e9).all()


def test_locating_by_any_matcher_and_way(harbour, encoded, text):
    for matcher in MATCHERS:
        for by in ("auto", *WAYS):
            if matcher.startswith("edit-distance") and by in ("all", "both", "auto"):
                continue
            options = {"matcher": matcher, "by": by, "encoded": encoded}
            if Matching(matcher=matcher, by=by).counts_cells:
                options["candidates"] = 8
            found = harbour.locate(text, **options)
            total = sum(mode.probability for mode in found.modes)
            assert 0.0 < total <= 1.0 + 1e-6
            assert found.best.cell in harbour.cells
            assert len(found.evidence) == 3


def test_fusing_nothing_is_relational_matching(harbour, make_network, text):
    nothing = EncodedCity(harbour, make_network(fusion=0.0))
    fused = harbour.locate(text, matcher="fused", encoded=nothing)
    plain = harbour.locate(text, matcher="relational")
    assert fused.best.probability == pytest.approx(plain.best.probability)
    assert fused.best.latitude == plain.best.latitude
    loud = EncodedCity(harbour, make_network(fusion=1.0))
    shifted = harbour.locate(text, matcher="fused", encoded=loud)
    assert [m.probability for m in shifted.modes] != pytest.approx(
        [m.probability for m in plain.modes], abs=1e-4
    )


@pytest.mark.parametrize("by", ["auto", *WAYS])
def test_locating_within_a_region_stays_there(harbour, encoded, text, make_description, by):
    west, south, east, north = whole(harbour)
    half = Region(west, south, (west + east) / 2, north)
    slack = 50.0 / 70_000.0  # a cell whose centre is in the region may reach beyond
    rare = make_description(
        (FOUNTAIN, "near", "me"), ("tourism=museum", "south", "me", {"far": True})
    )
    for matcher in ("relational", "fused", "transformer"):
        for told in (text, rare):
            found = harbour.locate(told, matcher=matcher, by=by, region=half, encoded=encoded)
            assert found.modes
            assert all(mode.longitude <= half.east + slack for mode in found.modes)


def test_a_region_over_the_date_line_and_one_that_is_none(harbour):
    at = harbour.cells.centers(np.arange(3))
    lon = harbour.plane.to_lonlat(at)[0, 0]
    assert find_in_region(harbour, at, Region(lon - 1.0, -90.0, lon - 2.0, 90.0)).all()
    assert not find_in_region(harbour, at, Region(lon + 1.0, -90.0, lon - 1.0, 90.0)).any()
    with pytest.raises(OptionError, match="is not a region"):
        find_in_region(harbour, at, Region(0.0, 50.0, 1.0, 40.0))


def test_locating_asks_a_store(harbour, encoded, text):
    class Store:
        asked = 0
        origin = encoded.origin

        def search(self, queries, n, region=None):
            Store.asked += 1
            return encoded.store.search(queries, n, region)

    found = harbour.locate(text, store=Store(), encoded=encoded)
    assert Store.asked == 1
    again = harbour.locate(text, by="both", encoded=encoded)
    assert found.best.probability == pytest.approx(again.best.probability)


def test_a_region_is_believed(harbour, encoded, text, make_description):
    at = harbour.locate(text, encoded=encoded).best
    assert at is not None
    d = 40.0 / 70_000.0
    box = Region(at.longitude - d, at.latitude - d, at.longitude + d, at.latitude + d)
    for by in ("auto", *WAYS):
        vague = make_description((BENCH, "near", "me"))
        anywhere = harbour.locate(vague, by=by, encoded=encoded)
        here = harbour.locate(vague, by=by, region=box, encoded=encoded)
        assert here.status is not Status.LOST
        assert here.best.probability > 3.0 * anywhere.best.probability


def test_a_region_holds_where_only_the_way_was_told(harbour, encoded):
    west, south, east, north = whole(harbour)
    you = ((west + east) / 2, (south + north) / 2)
    half = Region(west, south, you[0], north)
    found = harbour.locate("I am north of you.", listener=you, region=half, encoded=encoded)
    assert found.modes
    assert found.support[found.support[:, 2] > 0.0, 0].max() <= half.east


@pytest.mark.parametrize("matcher", MATCHERS)
def test_a_region_that_holds_nothing_is_said(harbour, encoded, text, matcher):
    nowhere = Region(0.0, 0.0, 1.0, 1.0)
    found = harbour.locate(text, matcher=matcher, region=nowhere, encoded=encoded)
    assert found.status is Status.LOST
    assert "no objects in (0.0, 0.0, 1.0, 1.0)" in found.reason


def test_the_store_of_another_map_or_network_is_refused(harbour, encoded, make_network, text):
    store = encoded.store
    others = (
        (replace(store, origin=replace(store.origin, map="0" * 32)), "another map"),
        (EncodedCity(harbour, make_network(fusion=0.8)).store, "another model"),
    )
    for other, says in others:
        with pytest.raises(StoreError, match=says):
            harbour.locate(text, store=other, encoded=encoded)
        with pytest.raises(StoreError, match=says):
            retrieve(harbour, text, store=other, encoded=encoded)
    unknown = replace(store, origin=Origin())
    assert harbour.locate(text, store=unknown, encoded=encoded).modes


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"matcher": "luck"}, "matcher is 'luck'.*'fused' or"),
        ({"by": "magic"}, "by is 'magic'.*'all' or 'auto'"),
        ({"matcher": "transformer", "score": "luck"}, "score is 'luck'.*'logit'"),
        ({"matcher": "relational", "score": "logit"}, "'relational'; remove it"),
        ({"region": (7.0, 43.0, 8.0, 44.0)}, r"region is \(7.0.*`Region`"),
        ({"store": "monaco.vectors"}, "store is 'monaco.vectors'.*open_store"),
        ({"encoded": "mine"}, "encoded is not"),
        *(({"candidates": n}, f"candidates is {n}") for n in (0, True, None, 1.5)),
        *(({"top": n}, f"top is {n!r}") for n in (0, "five")),
    ],
)
def test_bad_options_are_refused(harbour, encoded, text, options, says):
    for function in (harbour.locate, partial(retrieve, harbour)):
        with pytest.raises(OptionError, match=says):
            function(text, **{"encoded": encoded, **options})


def test_another_map_read_by_a_network_is_refused(harbour, encoded, text):
    other = replace(harbour, cells=replace(harbour.cells, size=60.0))
    with pytest.raises(OptionError, match="encoded is not"):
        harbour.locate(text, encoded=EncodedCity(other, encoded.network))
    again = replace(harbour, source="opened twice")
    assert harbour.locate(text, encoded=EncodedCity(again, encoded.network)).modes


def test_more_candidates_than_cells_are_all_cells(harbour, encoded, text):
    for matcher in ("relational", "embedding"):
        many = harbour.locate(text, matcher=matcher, by="dense", candidates=10**30, encoded=encoded)
        assert many.modes


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({}, "candidates is 5, but relational search with sparse"),
        ({"preset": "paper", "matcher": "fused"}, "but fused search with sparse"),
        ({"matcher": "embedding", "by": "all"}, "but embedding search with all"),
    ],
)
def test_a_count_of_cells_is_refused_where_none_are_counted(harbour, text, options, says):
    with pytest.raises(OptionError, match=says):
        harbour.locate(text, candidates=5, **options)


def test_embeddings_alone_are_never_sure(harbour, encoded, text):
    sure = harbour.locate(text, matcher="relational")
    found = harbour.locate(text, matcher="relational", by="dense", encoded=encoded, candidates=500)
    assert sure.best.probability > found.best.probability
    assert found.status is not Status.OK
    assert sum(mode.probability for mode in found.modes) <= 0.4 + 1e-9


def test_the_transformer_ranks_by_either_score(harbour, encoded, text, query):
    for by, field in (("cosine", "cosine"), ("logit", "logit"), (None, "logit")):
        options = {"score": by, "by": "all", "top": 9, "encoded": encoded}
        found = retrieve(harbour, text, matcher="transformer", **options)
        rows = np.arange(len(harbour.cells))
        match = encoded.match(encoded.text(query), encoded.cells, rows)
        best = np.sort(getattr(match, field))[::-1][:9]
        assert found.scores == pytest.approx(best, rel=1e-4, abs=1e-4)
        assert found.scores == pytest.approx(getattr(match, field)[found.rows], rel=1e-4, abs=1e-4)


def test_plain_edit_distance_is_the_textbooks(harbour, encoded, text):
    found = retrieve(
        harbour, text, matcher="edit-distance-plain", by="sparse", candidates=3, encoded=encoded
    )
    graphs = [harbour.graph(cell) for cell in found.cells]
    ranked = rank(text, graphs, timeout=0.1, plain=True)
    assert -found.scores == pytest.approx(ranked.costs)
    assert (found.scores < 0.0).all()  # a cell holds more than a text tells: that costs


def test_presets_give_way_to_what_is_said():
    paper = Matching.preset("paper")
    found = (paper.matcher, paper.score, paper.by, paper.candidates)
    assert found == ("transformer", "cosine", "dense", 10)
    assert paper.printed
    assert vars(Matching.preset("default")) == vars(Matching())
    assert Matching.preset("published").matcher == "embedding"
    assert Matching.preset("paper", score="logit").score == "logit"
    rules = Matching.preset("paper", matcher="edit-distance-plain", candidates=5)
    assert (rules.score, rules.by, rules.candidates) == (None, "dense", 5)
    other = Matching.preset("paper", matcher="relational")  # it looks at viewpoints, not at cells
    assert vars(other) == vars(Matching())
    assert Matching.preset("paper", matcher="fused", by="both", candidates=7).candidates == 7
    with pytest.raises(OptionError, match=r"preset is 'mine'.*paper"):
        Matching.preset("mine")
    with pytest.raises(OptionError, match="remove it"):
        Matching.preset("paper", matcher="relational", score="cosine")


def test_locating_as_the_paper_does(harbour, encoded, text):
    paper = harbour.locate(text, preset="paper", encoded=encoded)
    options = {"matcher": "transformer", "score": "cosine", "by": "dense", "candidates": 10}
    spelled = harbour.locate(text, **options, encoded=encoded)
    assert [m.cell for m in paper.modes] == [m.cell for m in spelled.modes]
    assert paper.best.probability == pytest.approx(spelled.best.probability)
    sharp = harbour.locate(text, preset="paper", score="logit", encoded=encoded)
    assert [m.probability for m in sharp.modes] != pytest.approx(
        [m.probability for m in paper.modes], abs=1e-4
    )


RANKING = [
    {"preset": "paper"},
    {"preset": "published"},
    {"preset": "paper", "matcher": "edit-distance-plain"},
    {"matcher": "edit-distance", "candidates": 5},
]


@pytest.mark.parametrize("options", RANKING)
def test_what_is_ranked_keeps_the_probability_of_the_prior(harbour, encoded, text, options):
    found = harbour.locate(text, encoded=encoded, **options)
    query = compile_query(text, harbour)
    plain = {k: v for k, v in options.items() if k != "preset"}
    matching = Matching.preset(options.get("preset", "default"), encoded=encoded, **plain)
    rows, scores = cells.rank_cells(Request(harbour, query, matching=matching))
    share = 1.0 / len(harbour.cells)
    assert found.ranked
    assert found.best.cell in {harbour.cells.id_of(r) for r in rows}
    best = harbour.cells.centers(rows[scores == scores.max()])
    at = harbour.plane.to_plane(np.array([[found.best.longitude, found.best.latitude]]))
    assert np.hypot(*(best - at).T).min() <= 50.0
    for mode in found.modes:
        assert 0.0 < mode.probability <= len(rows) * share


@pytest.mark.parametrize("options", [*RANKING, {"matcher": "transformer"}])
def test_ranks_are_no_probabilities_and_one_candidate_is_not_sure(harbour, encoded, text, options):
    assert harbour.locate(text, encoded=encoded, **options).status is not Status.OK
    one = harbour.locate(text, encoded=encoded, **options | {"candidates": 1})
    assert one.status is Status.AMBIGUOUS
    assert one.best.probability <= 1.0 / len(harbour.cells)


def test_matching_log_odds_are_shared_with_what_was_not_looked_at(harbour, encoded, text):
    every = harbour.locate(text, matcher="transformer", by="all", encoded=encoded)
    some = harbour.locate(text, matcher="transformer", candidates=5, encoded=encoded)
    assert not every.ranked
    assert some.support[:, 2].sum() < 0.97 - 1e-3
    assert every.support[:, 2].sum() == pytest.approx(0.97, abs=1e-3)


@pytest.mark.parametrize("printed", [False, True])
def test_dense_candidates_hold_no_more_than_their_recall(
    harbour, encoded, text, monkeypatch, printed
):
    query = compile_query(parse(harbour, text), harbour)
    network = EncodedCity.of_city(harbour, printed=True) if printed else encoded
    asked = Request(harbour, query, matching=Matching(by="dense", encoded=network))
    for reach in (0.5, 0.1):
        name = "PRINTED_DENSE_RECALL" if printed else "DENSE_RECALL"
        monkeypatch.setattr(posterior, name, reach)
        found = compute_posterior(asked, score_candidates(asked, find_candidates(asked)))
        assert found.probabilities.sum() <= reach + 1e-9
