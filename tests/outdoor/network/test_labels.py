"""Vectors of words: the same rows for ever, any letters, alike where spelled alike."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.outdoor.map.objects import of_name
from placegraph.outdoor.network.graphs import Bags
from placegraph.outdoor.network.graphs import split_label as words_of
from placegraph.outdoor.network.network_kernels import BUCKETS

# Weights that were shipped mean these rows: a change here makes all of them worthless.
GOLDEN = {
    "amenity=cafe": (
        [5134, 5695, 1994, 5964, 5912, 7017, 167, 997, 3426, 1817, 1562],
        0.3333333432674408,
    ),
    "~rex": ([4169, 1357, 3467, 3381, 3256, 7654, 3009], 0.40824830532073975),
    "": ([1025], 1.0),
    "öl_": ([4281, 5016, 6338, 1813], 0.5773502588272095),
    "喫茶": ([23, 6501, 930, 2493], 0.5773502588272095),
}

words = st.text(max_size=12) | st.text(alphabet="ab=_ ~<>é喫\U0001f600\ud800", max_size=12)


def table(width=8, seed=0):
    return np.random.default_rng(seed).standard_normal((BUCKETS, width)).astype(np.float32)


def test_rows_of_words_never_change():
    for word, (buckets, weight) in GOLDEN.items():
        bags = Bags.of([word])
        assert bags.buckets.tolist() == buckets, word
        assert bags.weights[-1] == np.float32(weight), word


def test_a_label_is_its_whole_its_key_and_the_letters_of_its_value():
    bags = Bags.of(["amenity=cafe", "cafe", "~cafe"])
    label, word, name = (
        bags.buckets[a:b].tolist() for a, b in zip(bags.starts, bags.starts[1:], strict=False)
    )
    assert bags.weights[:2].tolist() == [1.0, 0.5]
    letters = 4 + 3 + 2  # of <cafe>, in threes, fours and fives
    assert len(label) == 2 + letters
    assert label[2:] == word[1:] == name[1:]
    assert len({label[0], word[0], name[0]}) == 3
    assert np.isclose((bags.weights[2 : 2 + letters] ** 2).sum(), 1.0)


@pytest.mark.parametrize(
    ("label", "words"),
    [
        ("amenity=bicycle_parking", ("bicycle", "parking")),
        ("building=yes", ("building",)),
        ("man_made=*", ("man", "made")),
        ("Coffee Shop", ("coffee", "shop")),
        ("~Ripley's=Aquarium", ("ripley", "s", "aquarium")),
        ("öl_", ("öl",)),
        ("", ()),
    ],
)
def test_words_of_a_label_are_those_of_its_value(label, words):
    assert words_of(label) == words


def test_the_length_of_subwords_is_an_option():
    loud, still = Bags.of(["shop=bakery"], 2.0), Bags.of(["shop=bakery"], 0.0)
    assert (loud.weights[2:] > 0).all()
    assert not still.weights[2:].any()
    assert np.allclose(loud.weights[2:], 2.0 * Bags.of(["shop=bakery"]).weights[2:])


@given(st.lists(words, max_size=6))
def test_any_words_have_vectors_each_its_own_wherever_it_stands(found):
    bags, vectors = Bags.of(found), Bags.of(found).vectors(table())
    assert vectors.shape == (len(found), 8) or not found
    assert np.isfinite(vectors).all()
    assert (np.diff(bags.starts) >= 1).all()
    assert len(bags.buckets) == len(bags.weights) == bags.starts[-1]
    assert ((bags.buckets >= 0) & (bags.buckets < BUCKETS)).all()
    for word, vector in zip(found, vectors, strict=True):
        assert np.allclose(Bags.of([word]).vectors(table())[0], vector, atol=1e-5)


def cosine(a, b, width=256):
    x, y = Bags.of([a, b]).vectors(table(width))
    return float(x @ y / np.linalg.norm(x) / np.linalg.norm(y))


def test_unseen_words_resemble_what_is_spelled_alike():
    assert cosine("bakery", "bakeries") > cosine("bakery", "fountain") + 0.2
    assert (
        cosine("shop=bicycle_repair", "bicycle repair") > cosine("shop=bicycle_repair", "bar") + 0.2
    )
    assert cosine("~bäckerei kern", "~bäckerei kerner") > cosine("~bäckerei kern", "~rathaus") + 0.2


@given(st.text(max_size=20))
def test_names_are_marked_and_case_and_blanks_do_not_count(name):
    assert of_name(name).startswith("~")
    assert of_name(f"  {name} ") == of_name(name)
    assert of_name("BÄCKEREI  Kern") == of_name("Bäckerei Kern") == "~bäckerei kern"
