import numpy as np
import pytest

from placegraph.outdoor.network.graphs import (
    PlaceGraphs,
    WordWeights,
    list_nodes,
    make_word_fits,
)
from placegraph.outdoor.network.network_kernels import (
    CHANNEL_CHANCE,
    CHANNELS,
    LITERAL,
    NOISE,
    PAIR_SMOOTHING,
    SINGLE_SMOOTHING,
)
from placegraph_learn.city.batches import pair_batch


def test_a_text_in_a_batch_is_that_text(texts):
    every = np.arange(len(texts))
    batch = texts.batch(every)
    sizes = np.diff(texts.starts)
    assert batch.mask.sum(1).tolist() == sizes.tolist()
    assert batch.nodes[:, 0, 0].tolist() == [1.0] * len(texts)
    assert not batch.nodes[batch.mask == 0].any()
    for q in every:
        alone, n = texts.batch(np.array([q])), sizes[q]
        assert np.array_equal(batch.relations[q, :, :n, :n], alone.relations[0])
        assert np.array_equal(batch.nodes[q, :n], alone.nodes[0])
        assert not batch.relations[q, :, n:].any()
        assert not batch.relations[q, :, :, n:].any()


def test_a_place_in_a_batch_is_that_place(places):
    rows = np.arange(0, len(places), 7)
    batch = places.batch(rows)
    for i, k in enumerate(rows):
        alone, n = (
            places.batch(rows[i : i + 1]),
            places.starts[k + 1] - places.starts[k] + 1,
        )
        assert batch.mask[i].tolist() == [1.0] * n + [0.0] * (batch.mask.shape[1] - n)
        assert np.array_equal(batch.nodes[i, :n], alone.nodes[0])
        assert np.array_equal(batch.relations[i, :, :n, :n], alone.relations[0])
        mine = slice(places.starts[k], places.starts[k + 1])
        assert batch.nodes[i, 1:n, 4:6] * 25.0 == pytest.approx(places.offsets[mine], abs=1e-5)
        assert batch.nodes[i, 1:n, 1:4].argmax(1).tolist() == places.kinds[mine].tolist()
        assert np.allclose(batch.nodes[i, 1:n, 6], np.hypot(*places.offsets[mine].T) / 25.0)


def test_words_of_nodes_stand_where_their_nodes_do(places):
    rows = np.array([3, 0, 11])
    words = places.batch(rows).words
    size = places.batch(rows).mask.shape[1]
    bounds = [*words.starts.tolist(), len(words.words)]
    nodes, at = list_nodes(np.array([5, 0]), np.array([2, 3]), 4)
    assert nodes.tolist() == [5, 6, 0, 1, 2]
    assert at.tolist() == [0, 1, 4, 5, 6]
    assert list_nodes(np.array([5]), np.array([2]), 4, skip=1)[1].tolist() == [1, 2]
    starts, tokens = np.array([0, 0, 1, 3]), np.array([0, 1, 2], np.int32)
    weights = WordWeights(starts, tokens, np.ones(3, np.float32))
    fits = make_word_fits(weights, np.array([1, 60, 40]), 100)
    assert fits.rarity == pytest.approx([0.0, -np.log(0.01) / 10.0, 0.0])  # 0 of all who may be all
    for i, at in enumerate(words.at):
        graph, node = divmod(int(at), size)
        thing = places.starts[rows[graph]] + node - 1
        mine = slice(places.word_starts[thing], places.word_starts[thing + 1])
        assert words.words[bounds[i] : bounds[i + 1]].tolist() == places.words[mine].tolist()


@pytest.fixture(scope="module")
def paired(harbour, pool):
    views = pool.views[:3, :5]
    assert (views >= 0).all()
    places = PlaceGraphs.of_views(harbour, views.ravel())
    fits = pool.word_weights
    words = make_word_fits(fits, *harbour.word_counts)
    rows, every = np.arange(3), np.arange(len(places))
    return places, words, pair_batch(pool.texts, places, rows, every, (every // 5, every), words)


def test_agreement_is_how_well_words_of_the_map_fit(harbour, pool, paired):
    places, words, batch = paired
    texts = pool.texts
    assert (batch.agreement[:, 0, 0] == 1.0).all()  # the speaker is here
    assert not batch.agreement[:, 0, 1:].any()
    assert not batch.agreement[:, 1:, 0].any()
    shift = len(harbour.objects.labels)
    assert (words.tokens < shift).any()
    for p in range(len(batch.text)):
        q = batch.text[p]
        for node in range(1, texts.starts[q + 1] - texts.starts[q]):
            row = texts.starts[q] + node
            mine = slice(words.starts[row], words.starts[row + 1])
            fit = dict(zip(words.tokens[mine].tolist(), words.weights[mine].tolist(), strict=True))
            for i, thing in enumerate(range(places.starts[p], places.starts[p + 1])):
                w = slice(places.word_starts[thing], places.word_starts[thing + 1])
                known = zip(places.words[w].tolist(), places.weights[w].tolist(), strict=True)
                best = max([fit.get(word, 0.0) * weight for word, weight in known], default=0.0)
                assert batch.agreement[p, node, i + 1] == pytest.approx(best)


def test_what_holds_is_what_was_said_of_what_is_there(pool, paired):
    places, _, batch = paired
    there = places.batch(np.arange(len(places))).relations
    spoken = batch.spoken.astype(bool)
    said = batch.channels[..., : len(CHANNELS)]
    assert spoken.sum(1).tolist() == np.diff(pool.texts.edge_starts)[batch.text].tolist()
    assert np.allclose(batch.holds, np.einsum("psr,prij->psij", said, there), atol=1e-6)
    assert not batch.holds[~spoken].any()


def test_the_literal_reading_counts_pairs_that_fit_and_ends_in_a_likelihood_ratio(paired):
    places, _, batch = paired
    assert batch.literal.shape[2] == LITERAL
    of_me = 0
    for p in range(len(batch.text)):
        things = places.starts[p + 1] - places.starts[p]
        for s in np.flatnonzero(batch.spoken[p]):
            ends, said = batch.ends[p, s], batch.channels[p, s]
            a, b = batch.agreement[p, ends]
            held, alone = a @ batch.holds[p, s] @ b, ends.min() == 0
            counts = [held + 0.02, a.sum() + 0.02, b.sum() + 0.02, things + 1]
            assert batch.literal[p, s, :4] == pytest.approx(np.log(counts), rel=1e-3, abs=1e-4)
            rarity = np.exp(-10.0 * batch.rarity[p, ends].sum())
            chance = (said[:-1] * CHANNEL_CHANCE).sum() * rarity
            pairs = things * (things - 1) + PAIR_SMOOTHING
            ratio = held / (things + SINGLE_SMOOTHING if alone else pairs)
            ratio = np.exp(-2.0 * held) if said[-1] else min(ratio, 1.0) / max(chance, 1e-7)
            expected = np.log((1.0 - NOISE) * ratio + NOISE)
            assert batch.literal[p, s, 4] == pytest.approx(expected, rel=1e-3, abs=1e-3)
            of_me += alone
    assert of_me
