import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.cities import places_of_graphs

from placegraph.core.graph import SceneGraph
from placegraph.core.mapfile import pack_strings, read_map, write_map
from placegraph.errors import InputError, MapError
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.network import weights as module
from placegraph.outdoor.network.graphs import (
    PlaceGraphs,
    TextGraphs,
    WordVectors,
    find_word_weights,
    make_word_fits,
)
from placegraph.outdoor.network.network import GraphTransformer, MatchScores
from placegraph.outdoor.network.weights import (
    Shape,
    find_shipped_weights,
    read_weights,
    round_weights,
    write_weights,
)

WORD_VECTORS = WordVectors(
    ("bakery", "bench", "museum", "tree"),
    np.random.default_rng(5).normal(size=(4, 300)).astype(np.float32),
)
BAKERY, BENCH, FOUNTAIN, TREE = "shop=bakery", "amenity=bench", "amenity=fountain", "natural=tree"


@pytest.fixture(scope="module")
def words(harbour, pool):
    fits = pool.word_weights
    return make_word_fits(fits, *harbour.word_counts)


@pytest.fixture(scope="module")
def some(places):
    return np.arange(0, len(places), 6)


def test_embeddings_have_unit_length_and_do_not_depend_on_the_batch(network, texts, places, some):
    vectors = network.word_vectors(places.vocabulary)
    for embeddings, rows, encode in (
        (network.embed_texts(texts), range(len(texts)), lambda r: network.encode_texts(texts, r)),
        (network.embed_places(places), some, lambda r: network.encode_places(places, r, vectors)),
    ):
        assert embeddings.dtype == np.float32
        assert embeddings.shape[1] == network.shape.dimension
        assert np.allclose(np.linalg.norm(embeddings, axis=1), 1.0, atol=1e-5)
        for row in rows:
            assert encode(np.array([row])).embeddings[0] == pytest.approx(embeddings[row], abs=1e-5)


def assert_equal(found, expected, rel=1e-4):
    assert found.logit == pytest.approx(expected.logit, rel=rel, abs=1e-4)
    assert found.residual == pytest.approx(expected.residual, rel=rel, abs=1e-4)
    assert found.cosine == pytest.approx(expected.cosine, abs=1e-4)


def test_many_pairs_at_once_are_pairs_one_by_one(network, texts, places, words, some):
    for q in range(0, len(texts), 5):
        together = network.match(texts, q, places, some, words)
        assert together.logit.std() > 0.01  # places differ
        alone = [network.match(texts, q, places, np.array([k]), words) for k in some]
        assert_equal(MatchScores(*map(np.concatenate, zip(*alone, strict=True))), together)


def shuffled_things(places, rng):
    """The same places; their things stand in another order."""
    starts = places.starts
    order = [a + rng.permutation(b - a) for a, b in pairwise(starts)]
    order = np.concatenate(order)
    words = places.word_starts
    entry = np.concatenate([np.arange(words[i], words[i + 1]) for i in order])
    return replace(
        places, offsets=places.offsets[order], kinds=places.kinds[order],
        word_starts=np.concatenate(([0], np.cumsum(np.diff(words)[order]))),
        words=places.words[entry], weights=places.weights[entry],
    )  # fmt: skip


def test_the_order_of_things_does_not_matter(network, texts, places, words, some, rng):
    others = shuffled_things(places, rng)
    assert not np.array_equal(others.offsets, places.offsets)
    assert network.embed_places(others) == pytest.approx(network.embed_places(places), abs=1e-4)
    ours, theirs = (network.match(texts, 3, p, some, words) for p in (places, others))
    assert_equal(theirs, ours)


def test_the_order_of_mentions_and_statements_does_not_matter(
    network, harbour, places, some, make_description
):
    statements = [
        (TREE, "north", BENCH),
        (BAKERY, "near", "me"),
        (FOUNTAIN, "west", BAKERY),
        (BENCH, "visible", "me", {"negated": True}),
    ]
    found = []
    for order in ([0, 1, 2, 3], [2, 3, 1, 0]):
        text = make_description(*(statements[i] for i in order))
        graphs = TextGraphs.of([text])
        fits = find_word_weights(graphs, [compile_query(text, harbour)])
        words = make_word_fits(fits, *harbour.word_counts)
        found.append((network.embed_texts(graphs), network.match(graphs, 0, places, some, words)))
    (first, ours), (second, theirs) = found
    assert second == pytest.approx(first, abs=1e-5)
    assert_equal(theirs, ours)


class Watched(GraphTransformer):
    """Keeps what the joint model pools for the text."""

    def _pool(self, name, x, starts):
        pooled = super()._pool(name, x, starts)
        self.__dict__.setdefault("seen", {}).setdefault(name, []).append(pooled)
        return pooled


def watched(network):
    return Watched(network.shape, network.arrays, network.digest)


def test_cross_attention_sees_the_partner(network, make_network, texts, places, words, some):
    joint = watched(network)
    joint.match(texts, 0, places, some, words)
    (of_text,), (of_place,) = joint.seen["pool_text"], joint.seen["pool_place"]
    assert np.abs(of_text - of_text[0]).max(axis=1)[1:].min() > 1e-3
    # and the place's changes with the text
    other = watched(network)
    other.match(texts, 1, places, some, words)
    assert np.abs(other.seen["pool_place"][0] - of_place).max(axis=1).min() > 1e-3
    # without crossings nothing is exchanged
    apart = watched(make_network(crossings=0))
    apart.match(texts, 0, places, some, words)
    (of_text,) = apart.seen["pool_text"]
    assert np.abs(of_text - of_text[0]).max() < 1e-6


def test_a_place_without_things_is_a_place(network, texts, harbour, words):
    none = np.zeros(0, np.int64)
    empty = SceneGraph((), (), np.zeros((0, 2)), none, none, ())
    places = places_of_graphs([empty], np.zeros((1, 2)))
    places = replace(places, vocabulary=harbour.words)
    assert np.isfinite(network.embed_places(places)).all()
    assert np.isfinite(network.match(texts, 0, places, np.array([0]), words).logit).all()


@pytest.fixture(scope="module")
def batch(harbour, pool):
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_learn.city.batches import Lessons

    lessons = Lessons(harbour, pool)
    rows = np.arange(6)
    return lessons, rows, lessons.batch(rows, pool.views[rows] >= 0)


def torch_scores(numpy_network, lessons, batch):
    import torch

    from placegraph_learn.city.batches import forward
    from placegraph_learn.city.network import Network

    known = numpy_network.word_table
    module = Network(numpy_network.shape, known.vectors.shape[1] if known else 0)
    module.load_state_dict({n: torch.from_numpy(a) for n, a in numpy_network.arrays.items()})
    with torch.no_grad():
        scores = forward(module.eval(), lessons, batch, "cpu")
    return tuple(np.asarray(score) for score in scores)


SIZES = [{}, {"heads": 1, "subwords": 2.0}, {"known": WORD_VECTORS}]
MORE_SIZES = [{"layers": 0}, {"crossings": 0}]


@pytest.mark.parametrize(
    "sizes", [*SIZES, *(pytest.param(more, marks=pytest.mark.all) for more in MORE_SIZES)]
)
def test_numpy_is_torch(make_network, harbour, batch, words, sizes):
    ours = make_network(**sizes)
    lessons, rows, made = batch
    lessons = replace(lessons, subwords=ours.shape.subwords, word_vectors=ours.word_table)
    logit, cosine, embedding, residual = torch_scores(ours, lessons, made)
    texts = lessons.pool.texts
    places = PlaceGraphs.of_views(harbour, lessons.pool.views[lessons.pool.views >= 0])
    of_texts = ours.encode_texts(texts, rows).embeddings
    for q in rows:
        mine = np.flatnonzero(made.pairs.text == q)
        views = lessons.pool.views[q][made.slots[mine]]
        places = PlaceGraphs.of_views(harbour, views)
        found = ours.match(texts, int(q), places, np.arange(len(views)), words)
        assert found.logit == pytest.approx(logit[mine], rel=1e-4, abs=1e-4)
        assert found.cosine == pytest.approx(cosine[mine], rel=1e-4, abs=1e-5)
        assert found.residual == pytest.approx(residual[mine], rel=1e-4, abs=1e-4)
        assert found.embedding == pytest.approx(embedding[q, mine], rel=1e-4, abs=1e-5)
        assert ours.embed_places(places) @ of_texts.T == pytest.approx(
            embedding[:, mine].T, rel=1e-4, abs=1e-5
        )


def test_word_vectors_stand_for_the_words_they_know(make_network):
    plain, ours = make_network(), make_network(known=WORD_VECTORS)
    said = (TREE, "tree", "shop=tree_bench", FOUNTAIN, "~Rex")
    vectors, before = ours.word_vectors(said), plain.word_vectors(said)
    assert np.allclose(vectors[0], vectors[1])  # one word, one vector, whatever its key
    rows = WORD_VECTORS.vectors @ ours.arrays["meaning.weight"].T
    assert vectors[0] == pytest.approx(rows[3], rel=1e-5)
    assert vectors[2] == pytest.approx((rows[3] + rows[1]) / 2, rel=1e-4, abs=1e-4)
    assert np.array_equal(vectors[3:], before[3:])  # hashed, as without


def test_weights_have_the_names_and_shapes_of_torch(make_network):
    pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    from placegraph_learn.city.network import Network

    for sizes in ({}, {"layers": 3, "crossings": 1}, {"crossings": 0}, {"printed": True}):
        shape = make_network(**sizes).shape
        state = Network(shape).state_dict()
        assert {n: tuple(p.shape) for n, p in state.items()} == shape.arrays()


@pytest.fixture(scope="module")
def made(make_network):
    network = make_network(width=4, dimension=4, evidence=4)
    return round_weights(network.shape, network.arrays, {"note": "random"})


@pytest.fixture(scope="module")
def written(tmp_path_factory, made):
    path = tmp_path_factory.mktemp("weights") / "some.weights"
    write_weights(path, made)
    return path


@pytest.fixture
def file(tmp_path, written):
    return Path(shutil.copy(written, tmp_path))


@pytest.fixture(scope="module")
def knowing(make_network, tmp_path_factory):
    """A network with word vectors, its weights and their file."""
    known = WordVectors(("cafe", "öl"), np.float32([[1, 2, 3], [4, 5, 6]]))
    network = make_network(width=4, dimension=4, evidence=4, known=known)
    made = round_weights(network.shape, network.arrays, {}, known)
    write_weights(path := tmp_path_factory.mktemp("known") / "known.weights", made)
    return network, made, path


def rewritten(file, **changes):
    """The file with other metadata, arrays, kind or version."""
    known = read_map(file, module.KIND, module.VERSION)
    meta = {k: v for k, v in {**known.meta, **changes.pop("meta", {})}.items() if v is not None}
    arrays = {**known.arrays, **changes.pop("arrays", {})}
    arrays = {k: v for k, v in arrays.items() if v is not None}
    kind, version = changes.pop("kind", module.KIND), changes.pop("version", module.VERSION)
    assert not changes
    write_map(file, kind, version, meta, arrays)
    return file


def test_weights_come_back_as_they_were_written(file, made):
    found = read_weights(file)
    assert found.shape == made.shape
    assert found.training == {"note": "random"}
    assert found.arrays.keys() == made.arrays.keys()
    for name, array in made.arrays.items():
        assert array.dtype == np.float32
        assert np.array_equal(found.arrays[name], array)
    assert found.digest == made.digest
    network = GraphTransformer.open(file)
    assert network.digest == made.digest


def test_word_vectors_come_along(knowing):
    network, made, path = knowing
    found, known = GraphTransformer.open(path), network.word_table
    assert found.word_table.words == known.words
    assert np.array_equal(found.word_table.vectors, known.vectors)
    assert found.digest == made.digest
    for other in (None, WordVectors(("cafe", "oil"), known.vectors)):
        assert replace(made, words=other).digest != made.digest
    said = ("amenity=cafe", "~Öl", "shop=bakery")
    assert np.array_equal(
        found.word_vectors(said), replace(network, arrays=made.arrays).word_vectors(said)
    )


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"words": None}, "different labels"),
        ({"words": pack_strings(("cafe",))}, "different labels"),
        ({"words": pack_strings(("cafe", "cafe", "öl"))}, "different labels"),
        ({"word_vectors": None}, "word_vectors"),
        ({"word_vectors": np.zeros((3, 3), np.float16)}, "2 words with 3 vectors"),
        ({"word_vectors": np.zeros((2, 5), np.float16)}, r"meaning\.weight has shape"),
        ({"meaning.weight": None}, r"meaning\.weight"),
    ],
)
def test_word_vectors_that_do_not_fit_are_refused(tmp_path, knowing, arrays, says):
    path = Path(shutil.copy(knowing[2], tmp_path))
    with pytest.raises(MapError, match=says):
        GraphTransformer.open(rewritten(path, arrays=arrays))


def test_weights_are_small_and_their_digest_is_of_the_arrays(file, made):
    numbers = sum(a.size for a in made.arrays.values())
    assert file.stat().st_size < 2 * numbers + 20_000
    full = sum(np.prod(size) for size in Shape().arrays().values())
    assert 2 * full < 4_000_000  # what may ship
    bias = {"judge.2.bias": made.arrays["judge.2.bias"] + 1.0}
    assert replace(made, arrays=made.arrays | bias).digest != made.digest
    assert replace(made, training={}).digest == made.digest


def test_weights_of_before_are_not_those_as_printed(file, made):
    plain = {k: v for k, v in made.shape.to_dict().items() if k != "printed"}
    found = read_weights(rewritten(file, meta={"shape": plain | {"statements": True}}))
    assert found.shape == made.shape
    assert found.digest == made.digest


def test_the_shipped_network_is_sound():
    if not find_shipped_weights().exists():
        pytest.skip("no weights are shipped yet")
    assert find_shipped_weights().stat().st_size <= 4_000_000
    network = GraphTransformer.default()
    assert network is GraphTransformer.default()
    assert network.shape.dimension == 64
    assert network.digest == "b912c5c859e73f93"  # vectors that were kept are told by it
    printed = GraphTransformer.default(printed=True)
    assert printed.shape == Shape(printed=True, layers=1, crossings=1, heads=2)
    assert find_shipped_weights(printed=True).stat().st_size <= 1_500_000
    assert printed.digest == "df1378d765af03fb"


BAD_SHAPES = (
    None, [], {"width": "wide"}, {"width": 1 << 40}, {"depth": 3}, {"heads": 0},
    {"width": 48, "heads": 5}, {"layers": -1}, {"statements": False},
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"version": 2}, r"version 2, but this placegraph reads up to 1"),
        ({"kind": "city"}, r"is a city map, not a weights file"),
        (
            {"meta": {"labels": {"buckets": 64, "subwords": [3, 5]}}},
            "different labels",
        ),
        (
            {"meta": {"labels": None}},
            "different labels",
        ),
        (
            {"meta": {"graphs": {"channels": ["north"]}}},
            "'along', 'present'",
        ),
        *(({"meta": {"shape": shape}}, r"do not fit together") for shape in BAD_SHAPES),
        ({"meta": {"training": 3}}, r"do not fit together"),
        ({"arrays": {"table": None}}, r"'table' is missing"),
        ({"arrays": {"table": np.zeros((64, 4), np.float16)}}, r"table has shape \(64, 4\)"),
        ({"arrays": {"judge.2.bias": np.zeros((1, 1), np.float16)}}, r"judge\.2\.bias"),
        ({"arrays": {"judge.2.bias": np.zeros(1, np.float32)}}, r"judge\.2\.bias"),
    ],
)
def test_what_does_not_fit_is_refused(file, changes, says):
    with pytest.raises(MapError, match=says):
        GraphTransformer.open(rewritten(file, **changes))


def test_what_is_no_weights_file_is_refused(tmp_path, harbour_file):
    with pytest.raises(MapError, match=r"city map, not a weights file"):
        read_weights(harbour_file)
    text = tmp_path / "some.weights"
    text.write_text(json.dumps({"table": []}), "utf-8")
    with pytest.raises(MapError, match=r"city train"):
        read_weights(text)


def test_a_missing_file_is_not_a_map_to_build(tmp_path):
    for path in (tmp_path / "gone.weights", tmp_path / "gone.city", tmp_path):
        with pytest.raises(InputError, match=r"weights file .*city train") as caught:
            read_weights(path)
        assert "city build" not in str(caught.value)
