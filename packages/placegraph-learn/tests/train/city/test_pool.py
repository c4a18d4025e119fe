"""Examples with what is easily confused with their places."""

import numpy as np
import pytest

from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.search.candidates import candidates
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.rerank import HARD
from placegraph.outdoor.search.viewpoints import score
from placegraph_learn.train.city.pool import AT, NEARBY, OTHERS, fill


def test_what_is_right_follows_from_distance(pool, harbour):
    assert len(pool) == 24
    assert pool.views.shape == pool.right.shape == pool.scores.shape == (24, HARD + OTHERS + 4)
    there = pool.views >= 0
    delta = np.abs(harbour.views.positions[pool.views] - pool.positions[:, None]).max(axis=2)
    assert (pool.right[there & (delta <= AT)] == 1).all()
    assert (pool.right[there & (delta > AT) & (delta <= NEARBY)] == -1).all()
    assert (pool.right[there & (delta > NEARBY)] == 0).all()
    assert (pool.right[~there] == -1).all()


def test_every_text_has_right_and_wrong_places_none_twice(pool):
    assert (pool.right == 1).any(axis=1).all()
    assert (pool.right == 0).any(axis=1).mean() > 0.75  # in a small town some have none to see
    for row in pool.views:
        known = row[row >= 0]
        assert len(set(known.tolist())) == len(known)


def test_hard_candidates_are_those_of_relational_matching(speakers):
    speaker, seen = speakers[0], []
    made = fill(speaker, 5, np.random.default_rng(11), lambda: seen.append(1))
    assert len(seen) == 5
    told = speaker.examples(np.random.default_rng(11))
    query = compile_query(next(told).description, speaker.city)
    asked = Request(speaker.city, query)
    found = score(asked, candidates(asked))
    best = found.rows[np.argsort(-found.scores, kind="stable")]
    best = best[speaker.may_see(speaker.city.views.positions_of(best))][:HARD]
    assert set(best.tolist()) <= set(made.views[0].tolist())
    known = dict(zip(found.rows.tolist(), found.scores.tolist(), strict=True))
    for view, value in zip(made.views[0].tolist(), made.scores[0].tolist(), strict=True):
        if view in known:
            assert value == pytest.approx(known[view])
        else:
            assert np.isnan(value)


def test_pools_are_seeded(speakers):
    first, second = (fill(speakers[0], 3, np.random.default_rng(2)) for _ in range(2))
    assert np.array_equal(first.positions, second.positions)
    assert np.array_equal(first.views, second.views)
    assert first.texts.vocabulary == second.texts.vocabulary


def test_fits_are_the_words_of_the_map(pool, harbour):
    fits, texts = pool.fits, pool.texts
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
