"""Weights in map files."""

import numpy as np
import pytest

from placegraph.core.mapfile import read_map, write_map
from placegraph.core.weights import hash_weights, read_arrays, round_to_float16, to_float16
from placegraph.errors import MapError


@pytest.fixture
def state(rng):
    return {"b": rng.normal(size=(3, 4)), "a": rng.normal(size=5).astype(np.float32)}


def test_arrays_come_back_rounded(state, tmp_path):
    held = round_to_float16(["a", "b"], state)
    assert all(array.dtype == np.float32 for array in held.values())
    assert held["b"] == pytest.approx(state["b"], rel=1e-3)
    write_map(tmp_path / "w", "weights", 1, {}, to_float16(state))
    file = read_map(tmp_path / "w", "weights", 1)
    again = read_arrays(file, {"a": (5,), "b": (3, 4)})
    assert all(np.array_equal(again[name], held[name]) for name in held)
    for sizes in ({"a": (5, 1)}, {"c": (5,)}):
        with pytest.raises(MapError):
            read_arrays(file, sizes)


def test_a_digest_is_of_shape_names_and_what_the_file_holds(state):
    one = hash_weights("shape", state)
    assert len(one) == 64
    assert one == hash_weights("shape", round_to_float16(["a", "b"], state))
    assert one == hash_weights("shape", dict(reversed(state.items())))
    others = hash_weights("other", state), hash_weights("shape", state | {"a": state["a"] + 1})
    assert len({one, *others, hash_weights("shape", {"c": state["a"], "b": state["b"]})}) == 4


def test_numbers_that_are_none(state, tmp_path):
    bad = np.full((3, 4), np.nan)
    write_map(tmp_path / "w", "weights", 1, {}, to_float16(state | {"b": bad}))
    with pytest.raises(ValueError, match="b contains"):
        read_arrays(read_map(tmp_path / "w", "weights", 1), {"a": (5,), "b": (3, 4)})
