"""Weights files: what fits is read as it was written, what does not is refused with a mend."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placegraph.core.mapfile import pack_strings, read_map, write_map
from placegraph.errors import InputError, MapError, PlacegraphError
from placegraph.outdoor.network import weights as module
from placegraph.outdoor.network.graphs import WordVectors
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.network.weights import Shape, read_weights, shipped, trained, write_weights


@pytest.fixture(scope="module")
def made(make_network):
    network = make_network(width=4, dimension=4, evidence=4)
    return trained(network.shape, network.arrays, {"note": "random"})


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
    made = trained(network.shape, network.arrays, {}, known)
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
    assert found.fingerprint == made.fingerprint
    network = GraphTransformer.open(file)
    assert network.fingerprint == made.fingerprint


def test_word_vectors_come_along(knowing):
    network, made, path = knowing
    found, known = GraphTransformer.open(path), network.known
    assert found.known.words == known.words
    assert np.array_equal(found.known.vectors, known.vectors)
    assert found.fingerprint == made.fingerprint
    for other in (None, WordVectors(("cafe", "oil"), known.vectors)):
        assert replace(made, words=other).fingerprint != made.fingerprint
    said = ("amenity=cafe", "~Öl", "shop=bakery")
    assert np.array_equal(
        found.word_vectors(said), replace(network, arrays=made.arrays).word_vectors(said)
    )


@pytest.mark.parametrize(
    ("arrays", "says"),
    [
        ({"words": None}, "other labels"),
        ({"words": pack_strings(("cafe",))}, "other labels"),
        ({"words": pack_strings(("cafe", "cafe", "öl"))}, "other labels"),
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


def test_weights_are_small(file, made):
    numbers = sum(a.size for a in made.arrays.values())
    assert file.stat().st_size < 2 * numbers + 20_000
    full = sum(np.prod(size) for size in Shape().arrays().values())
    assert 2 * full < 4_000_000  # what may ship


def test_fingerprints_tell_networks_apart(made):
    other = dict(made.arrays)
    other["judge.2.bias"] = other["judge.2.bias"] + 1.0
    assert replace(made, arrays=other).fingerprint != made.fingerprint
    assert replace(made, training={}).fingerprint == made.fingerprint


def test_weights_of_before_are_those_with_statements(file, made):
    plain = {k: v for k, v in made.shape.to_dict().items() if k != "statements"}
    found = read_weights(rewritten(file, meta={"shape": plain}))
    assert found.shape == made.shape
    assert found.fingerprint == made.fingerprint


def test_the_shipped_network_is_sound():
    if not shipped().exists():
        pytest.skip("no weights are shipped yet")
    assert shipped().stat().st_size <= 4_000_000
    network = GraphTransformer.default()
    assert network is GraphTransformer.default()
    assert network.shape.dimension == 64
    assert network.fingerprint == "b912c5c859e73f93"  # vectors that were kept are told by it


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"version": 2}, r"version 2, this placegraph reads up to 1"),
        ({"kind": "city"}, r"is a city map, not a weights file"),
        ({"meta": {"labels": {"buckets": 64, "subwords": [3, 5]}}}, r"other labels.*city train"),
        ({"meta": {"labels": None}}, r"other labels"),
        ({"meta": {"graphs": {"channels": ["north"]}}}, r"other graphs"),
        ({"meta": {"shape": None}}, r"do not fit together"),
        ({"meta": {"shape": {"width": "wide"}}}, r"do not fit together"),
        ({"meta": {"shape": {"width": 1 << 40}}}, r"do not fit together"),
        ({"meta": {"shape": {"depth": 3}}}, r"do not fit together"),
        ({"meta": {"shape": []}}, r"do not fit together"),
        ({"meta": {"shape": {"heads": 0}}}, r"do not fit together"),
        ({"meta": {"shape": {"width": 48, "heads": 5}}}, r"do not fit together"),
        ({"meta": {"shape": {"layers": -1}}}, r"do not fit together"),
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


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_a_file_that_is_cut_off_is_refused(file, share):
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(PlacegraphError, match=r"some\.weights"):
        read_weights(file)


def test_a_flipped_bit_is_noticed(file, rng):
    data = file.read_bytes()
    for at in rng.integers(len(data), size=6):
        file.write_bytes(data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :])
        with pytest.raises(PlacegraphError, match=r"some\.weights"):
            read_weights(file)


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


def test_an_unwritable_folder_is_an_error(tmp_path, made):
    with pytest.raises(PlacegraphError, match=r"gone"):
        write_weights(tmp_path / "gone" / "some.weights", made)
    assert not list(tmp_path.iterdir())
