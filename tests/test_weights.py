"""What files of weights of both wings share."""

import numpy as np
import pytest

from placegraph.errors import MapError
from placegraph.store import read_map, write_map
from placegraph.weights import arrays_of, digest, halves, rounded


@pytest.fixture
def state(rng):
    return {"b": rng.normal(size=(3, 4)), "a": rng.normal(size=5).astype(np.float32)}


def test_arrays_come_back_rounded(state, tmp_path):
    held = rounded(["a", "b"], state)
    assert all(array.dtype == np.float32 for array in held.values())
    assert held["b"] == pytest.approx(state["b"], rel=1e-3)
    write_map(tmp_path / "w", "weights", 1, {}, halves(state))
    file = read_map(tmp_path / "w", "weights", 1)
    again = arrays_of(file, {"a": (5,), "b": (3, 4)})
    assert all(np.array_equal(again[name], held[name]) for name in held)
    for sizes in ({"a": (5, 1)}, {"c": (5,)}):
        with pytest.raises(MapError):
            arrays_of(file, sizes)


def test_a_digest_is_of_shape_names_and_what_the_file_holds(state):
    one = digest("shape", state)
    assert len(one) == 64
    assert one == digest("shape", rounded(["a", "b"], state))
    assert one == digest("shape", dict(reversed(state.items())))
    others = digest("other", state), digest("shape", state | {"a": state["a"] + 1})
    assert len({one, *others, digest("shape", {"c": state["a"], "b": state["b"]})}) == 4


def test_numbers_that_are_none(state, tmp_path):
    bad = np.full((3, 4), np.nan)
    write_map(tmp_path / "w", "weights", 1, {}, halves(state | {"b": bad}))
    with pytest.raises(ValueError, match="b holds"):
        arrays_of(read_map(tmp_path / "w", "weights", 1), {"a": (5,), "b": (3, 4)})
