from itertools import islice

import numpy as np
import pytest

from placegraph.core.geometry import angle_between
from placegraph.errors import OptionError
from placegraph.outdoor.language.description import SPEAKER, Relation
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.posterior import NUM_RERANKED, find_candidates, score_candidates
from placegraph.outdoor.search.request import Request
from placegraph_learn.city import descriptions as sample
from placegraph_learn.city.descriptions import (
    AT,
    NEARBY,
    OTHERS,
    SIGHT,
    TILE,
    Speaker,
    held_out,
    make_pool,
)


def examples(speaker, n, seed=0):
    return list(islice(speaker.examples(np.random.default_rng(seed)), n))


def test_one_tile_in_four_is_held_out():
    east, north = np.meshgrid(*[TILE * (np.arange(-20, 20) + 0.5)] * 2)
    held = held_out(east, north)
    assert held.mean() == 0.25
    assert (held.mean(axis=0) == 0.25).all()
    assert (held.mean(axis=1) == 0.25).all()
    inside = held_out(east + 0.49 * TILE, north - 0.49 * TILE)
    assert np.array_equal(inside, held)
    assert held_out(1.0, 1.0)
    assert not held_out(-1.0, 1.0)


@pytest.mark.parametrize("held", [False, True])
def test_speakers_stand_in_their_tiles_and_are_seeded(speakers, held):
    speaker = speakers[held]
    ours, same, other = (examples(speaker, 20, seed) for seed in (3, 3, 4))
    assert all(held_out(*example.position) == held for example in (*ours, *other))
    assert (held_out(*speaker.city.views.positions[speaker.places].T) == held).all()
    assert [e.description for e in ours] == [e.description for e in same]
    assert [tuple(e.position) for e in ours] == [tuple(e.position) for e in same]
    assert [e.description for e in ours] != [e.description for e in other]


@pytest.fixture
def talk(speakers, monkeypatch):
    """Statements of speakers with habits: `talk(about, n, erring)` yields city, example, statement."""

    def draw_statements(about, n, erring=0.0):
        habits = sample._Habits(erring, 0.0, "tags", "de", 0.0, about)
        monkeypatch.setattr(sample, "draw_habits", lambda _: habits)
        for example in examples(speakers[0], n):
            for statement in example.description.statements:
                yield speakers[0].city, example, statement

    return draw_statements


def things(city, words):
    o, rows = city.objects, []
    for i in range(len(o)):
        labels = [o.labels[k] for k in o.label_values[o.label_starts[i] : o.label_starts[i + 1]]]
        if words in {o.name(i), *(part for label in labels for part in label.split("=", 1))}:
            rows.append(i)
    return rows


def seen_from(city, example, mention):
    """Rows (N,) of what a mention may mean, and where they stand from the speaker (N, 2)."""
    rows = things(city, example.description.mentions[mention].words)
    return np.array(rows), at(city, rows, example.position) - example.position


def at(city, rows, position):
    return sample.look_around(city, np.array(rows, np.int32), np.asarray(position, np.float64)).at


def points_to(delta, bearing):
    return np.abs(angle_between(np.arctan2(*delta), bearing)) <= np.pi / 4 + 1e-6


def test_directions_from_the_speaker_are_true(talk):
    said = 0
    for city, example, s in talk("me", 25):
        assert s.relation is Relation.DIRECTION
        assert s.target == SPEAKER
        delta = seen_from(city, example, s.source)[1]
        near = np.hypot(*delta.T) <= 1.2 * SIGHT
        # of the eight winds here, each is at most a quarter turn off
        assert any(points_to(d, s.bearing) for d in delta[near])
        said += 1
    assert said > 75


def test_directions_between_things_are_true(talk):
    said = 0
    for city, example, s in talk("pairs", 25):
        a, b = (seen_from(city, example, end)[1] for end in (s.source, s.target))
        a, b = (x[np.hypot(*x.T) <= SIGHT + 1e-6] for x in (a, b))
        delta = (a[:, None] - b[None]).reshape(-1, 2)
        delta = delta[np.hypot(*delta.T) >= 1.0]
        assert any(points_to(d, s.bearing) for d in delta)
        said += 1
    assert said > 75


def test_with_every_direction_drawn_at_random_one_in_four_is_right(talk):
    right = []
    for city, example, s in talk("me", 40, erring=1.0):
        delta = seen_from(city, example, s.source)[1]
        right.append(bool(points_to(delta[np.argmin(np.hypot(*delta.T))], s.bearing)))
    assert 0.1 < np.mean(right) < 0.5


def test_places_and_absences_are_true(talk):
    seen = set()
    for city, example, s in talk("mixed", 60):
        o = city.objects
        rows, delta = seen_from(city, example, s.target if s.source == SPEAKER else s.source)
        close = np.hypot(*delta.T)
        seen.add((s.relation, s.negated))
        if s.negated:
            # one of the labels that are called so is the first of nothing in sight
            first = np.array([o.label(i) for i in rows])
            assert max(close[first == label].min() for label in set(first)) > SIGHT
        elif s.relation is Relation.NEAR and SPEAKER in (s.source, s.target):
            assert close.min() < 20.0
        elif s.relation is Relation.ALONG:
            assert close[o.kind[rows] == sample.LINE].min() < 8.0
        elif s.relation is Relation.INSIDE:
            off = sample._nearest(
                o.kind, o.part_starts, o.point_starts, o.points, rows.astype(np.int32), *example.position
            )  # fmt: skip
            assert (np.hypot(*off.T) == 0.0).any()
    assert {(Relation.VISIBLE, True), (Relation.VISIBLE, False), (Relation.NEAR, False)} <= seen
    assert {(Relation.ALONG, False), (Relation.DIRECTION, False)} <= seen


def test_speakers_differ_in_their_words(speakers):
    found = examples(speakers[0], 120, seed=9)
    mentions = [m for e in found for m in e.description.mentions[2:]]
    assert any(m.name for m in mentions)
    assert any(m.count and m.count > 1 for m in mentions)
    foreign = {m.words for m in mentions if not m.words.isascii()}
    assert foreign
    assert {s.relation for e in found for s in e.description.statements} >= {
        Relation.DIRECTION, Relation.NEAR, Relation.VISIBLE, Relation.ALONG,
    }  # fmt: skip
    assert all(3 <= len(e.description.statements) <= 10 for e in found)
    assert all(s.source != s.target for e in found for s in e.description.statements)
    for example in found:  # the same word is the same node
        called = [m.name or m.words for m in example.description.mentions[2:]]
        assert len(set(called)) == len(called)
    assert sum(bool(m.senses) for m in mentions) > 0.9 * len(mentions)  # the vocabulary knows them


def test_a_city_with_nothing_to_say_is_refused(build_world, vocabulary):
    city = build_world([(0.0, 0.0, {"amenity": "bench"}), (8.0, 0.0, {"natural": "tree"})])
    with pytest.raises(
        OptionError, match=r"CityMap\('world\.osm', 2 objects, 1 cells\) has no place with"
    ):
        Speaker(city, vocabulary).places  # noqa: B018


def test_what_is_right_follows_from_distance(pool, harbour):
    assert len(pool) == 24
    assert (
        pool.views.shape == pool.right.shape == pool.scores.shape == (24, NUM_RERANKED + OTHERS + 4)
    )
    there = pool.views >= 0
    delta = np.abs(harbour.views.positions[pool.views] - pool.positions[:, None]).max(axis=2)
    assert (pool.right[there & (delta <= AT)] == 1).all()
    assert (pool.right[there & (delta > AT) & (delta <= NEARBY)] == -1).all()
    assert (pool.right[there & (delta > NEARBY)] == 0).all()
    assert (pool.right[~there] == -1).all()
    assert (pool.right == 1).any(axis=1).all()
    assert (pool.right == 0).any(axis=1).mean() > 0.75  # in a small town some have none to see
    assert all(len(set(row[row >= 0])) == (row >= 0).sum() for row in pool.views)


def test_hard_candidates_are_those_of_relational_matching(speakers):
    speaker, seen = speakers[0], []
    made = make_pool(speaker, 5, np.random.default_rng(11), lambda: seen.append(1))
    assert len(seen) == 5
    again = make_pool(speaker, 5, np.random.default_rng(11))
    assert np.array_equal(made.positions, again.positions)
    assert np.array_equal(made.views, again.views)
    assert made.texts.vocabulary == again.texts.vocabulary
    told = speaker.examples(np.random.default_rng(11))
    query = compile_query(next(told).description, speaker.city)
    asked = Request(speaker.city, query)
    found = score_candidates(asked, find_candidates(asked))
    best = found.rows[np.argsort(-found.scores, kind="stable")]
    best = best[speaker.may_see(speaker.city.views.positions_of(best))][:NUM_RERANKED]
    assert set(best.tolist()) <= set(made.views[0].tolist())
    known = dict(zip(found.rows.tolist(), found.scores.tolist(), strict=True))
    for view, value in zip(made.views[0].tolist(), made.scores[0].tolist(), strict=True):
        if view in known:
            assert value == pytest.approx(known[view])
        else:
            assert np.isnan(value)


def test_fits_are_the_words_of_the_map(pool, harbour):
    fits, texts = pool.word_weights, pool.texts
    assert len(fits.starts) == len(texts.mentions) + 1
    speakers = texts.starts[:-1]
    assert (fits.starts[speakers] == fits.starts[speakers + 1]).all()  # a speaker is no thing
    assert fits.tokens.max() < len(harbour.words)
    assert (fits.weights > 0).all()
    literal = 0
    for node in range(len(texts.mentions)):
        mine = slice(texts.word_starts[node], texts.word_starts[node + 1])
        known = {texts.vocabulary[w] for w in texts.words[mine]} & set(harbour.objects.labels)
        fit = {harbour.words[t] for t in fits.tokens[fits.starts[node] : fits.starts[node + 1]]}
        named = any(
            word.startswith("~") for word in fit
        )  # a name means what bears it, not its kind
        assert named or known <= fit
        literal += len(known)
    assert literal > 24
