import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import damaged, refusing

from placegraph.errors import InputError
from placegraph_learn.city.word2vec import read_word2vec

WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Z", "C")), min_size=1, max_size=6)


def written(words, vectors, *, binary, line_feeds=False):
    head = f"{len(words)} {vectors.shape[1]}\n".encode()
    if not binary:
        lines = (
            f"{w} {' '.join(map(repr, v.tolist()))}\n" for w, v in zip(words, vectors, strict=True)
        )
        return head + "".join(lines).encode()
    end = b"\n" if line_feeds else b""
    blocks = (
        w.encode() + b" " + v.astype("<f4").tobytes() + end
        for w, v in zip(words, vectors, strict=True)
    )
    return head + b"".join(blocks)


@pytest.fixture
def file(tmp_path):
    return tmp_path / "words.vec"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("vectors")


@given(
    st.dictionaries(WORDS, st.integers(0, 2**32 - 1), min_size=1, max_size=8),
    st.integers(1, 5),
    st.sampled_from([(False, False), (True, False), (True, True)]),
)
def test_words_come_back_in_every_form(folder, entries, length, form):
    binary, line_feeds = form
    words = list(entries)
    vectors = np.stack([np.random.default_rng(s).normal(size=length) for s in entries.values()])
    vectors = vectors.astype(np.float32)
    path = folder / "any.vec"
    path.write_bytes(written(words, vectors, binary=binary, line_feeds=line_feeds))
    found = read_word2vec(path, {w.lower() for w in words})
    assert set(found.words) == {w.lower() for w in words}
    assert found.words == tuple(sorted(found.words))
    for word, vector in zip(words, vectors, strict=True):
        alike = [w for w in words if w.lower() == word.lower()]
        if word == word.lower() or alike == [word]:
            row = found.words.index(word.lower())
            assert np.array_equal(found.vectors[row], vector.astype(np.float16).astype(np.float32))


@given(st.data())
def test_damage_is_refused_or_harmless(folder, data):
    vectors = np.random.default_rng(1).normal(size=(3, 4)).astype(np.float32)
    raw = written(["cafe", "Tree", "öl"], vectors, binary=data.draw(st.booleans()))
    path = folder / "fuzz.vec"
    path.write_bytes(data.draw(damaged(raw) | st.binary(max_size=80)))
    with refusing("fuzz.vec"):
        assert np.isfinite(read_word2vec(path, {"cafe", "tree", "öl"}).vectors).all()


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (b"", "does not begin with the number of words"),
        (b"cafe 1 2 3\n", "does not begin with the number of words"),
        (b"-1 3\n", "does not begin with the number of words"),
        (b"0 3\n", "0 words of 3 numbers"),
        (b"1 0\n", "1 words of 0 numbers"),
        (b"1 99999\n", "1 words of 99999 numbers"),
        (b"3000000 300\ncafe 1 2\n", "too short"),
        (b"9999999999 300\n", "words.vec"),
        (b"2 2\ncafe 1 2\ntree 1\n\n\n", "word 2 of 2"),
        (b"1 2\ncafe 1 2\ntree 1 2\n", "continues after the 1 words"),
        (b"2 2\ncafe 1 2\ntree 1 nan\n", "'tree' contains a value that is not a number"),
        (b"2 2\ncafe 1 2\ntree 1 e\n", "'tree' contains a value that is not a number"),
        (b"1 2\ncafe 1 1e9\n", "'cafe' contains a value that is not a number"),
        (b"1 2\nhouse 1 2\n", "has vectors for none of the 2 words"),
        (gzip.compress(b"1 2\ncafe 1 2\n", mtime=0), "gunzip"),
    ],
)
def test_what_is_wrong_is_said(file, raw, says):
    file.write_bytes(raw)
    with pytest.raises(InputError, match=says):
        read_word2vec(file, {"cafe", "tree"})


def test_a_missing_file_is_named(tmp_path):
    for path in (tmp_path / "gone.vec", tmp_path):
        with pytest.raises(InputError, match="give a word2vec file"):
            read_word2vec(path, {"cafe"})


def test_small_letters_go_before_the_first_in_capitals(file):
    file.write_text("4 1\nBar 1\nBAR 2\nCafe 3\ncafe 4\n", "utf-8")
    found = read_word2vec(file, {"cafe", "bar"})
    assert dict(zip(found.words, found.vectors[:, 0].tolist(), strict=True)) == {
        "bar": 1,
        "cafe": 4,
    }
