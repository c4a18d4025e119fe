"""Weights from files."""

import subprocess
import sys

import numpy as np
import pytest

from placegraph.core.mapfile import read_map, write_map
from placegraph.core.networks import hash_weights, read_arrays, round_to_float16, to_float16
from placegraph.errors import MapError

CUT = """
import os, sys
from pathlib import Path
import torch
from {module} import {reader} as read
path = Path(sys.argv[1])
weights = read({arguments})
weights = weights[0] if isinstance(weights, tuple) else weights
os.truncate(path, 10)
print(float(weights["a"].sum()))
"""
READERS = {
    "networks": ("placegraph.core.networks", "read_state", "torch, path, 'x'", "pt"),
    "backbone": ("placegraph_learn.features", "_state", "torch, path, 'x'", "safetensors"),
    "scenegraphloc": (
        "placegraph_learn.scenegraphloc.weights", "read_state", "path", "safetensors",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "name", ["networks", *(pytest.param(name, marks=pytest.mark.all) for name in list(READERS)[1:])]
)
def test_a_file_that_is_cut_short_while_its_weights_are_used_ends_no_process(name, tmp_path):
    torch = pytest.importorskip("torch", reason="needs PyTorch (extra learn)")
    tensors = pytest.importorskip("safetensors.torch", reason="needs safetensors (extra learn)")
    module, reader, arguments, ending = READERS[name]
    path = tmp_path / f"a.{ending}"
    (torch.save if ending == "pt" else tensors.save_file)({"a": torch.ones(1 << 16)}, path)
    program = CUT.format(module=module, reader=reader, arguments=arguments)
    command = [sys.executable, "-c", program, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert (done.returncode, done.stdout) == (0, "65536.0\n"), done.stderr


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
    with pytest.raises(ValueError, match="b holds"):
        read_arrays(read_map(tmp_path / "w", "weights", 1), {"a": (5,), "b": (3, 4)})
