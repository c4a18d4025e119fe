import builtins
import codecs
import os
import pickle
import pickletools
import struct
import sys
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import InputError
from placegraph_lab.datasets.kitti360pose import RELEASE
from placegraph_lab.datasets.pickles import Record, read_pickle, unwrap_array

MODULE = RELEASE.module


PROTOCOLS = (2, 3, 4, 5)
ARRAYS = [
    np.arange(12.0).reshape(4, 3), np.arange(12, dtype=np.float32).reshape(4, 3)[:, ::2],
    np.asfortranarray(np.arange(6).reshape(2, 3)), np.arange(5, dtype=">i2"),
    np.array([True, False]), np.zeros((0, 3)), np.array(2.5), np.arange(3, dtype=np.uint8),
]  # fmt: skip


class Anything:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def stored(tmp_path, raw):
    path = tmp_path / "x.pkl"
    path.write_bytes(raw)
    return path


def loaded(tmp_path, raw):
    return read_pickle(stored(tmp_path, raw), RELEASE)


def refused(tmp_path, raw, *words):
    with pytest.raises(InputError) as caught:
        loaded(tmp_path, raw)
    message = str(caught.value)
    assert str(tmp_path / "x.pkl") in message
    assert message.endswith(".")
    for word in words:
        assert word in message
    return message


def as_numpy_1(raw):
    for name in ("multiarray", "numeric"):
        new, old = f"numpy._core.{name}".encode(), f"numpy.core.{name}".encode()
        raw = raw.replace(b"c" + new, b"c" + old)
        for tag, size in ((b"\x8c", "<B"), (b"X", "<I")):
            raw = raw.replace(
                tag + struct.pack(size, len(new)) + new, tag + struct.pack(size, len(old)) + old
            )
    return pickletools.optimize(raw)  # frames anew


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("spelling", [lambda raw: raw, as_numpy_1])
def test_arrays_and_numbers_of_both_numpys(tmp_path, protocol, spelling):
    numbers = [np.float64(0.1), np.int32(-7), np.bool_(True), np.float32(0.5), 3, 1 << 70, 0.25]
    told = {"arrays": ARRAYS, "numbers": numbers, "text": "größer", "none": (None, True, False)}
    raw = spelling(pickle.dumps(told, protocol=protocol))
    assert (b"numpy._core" in raw) == (spelling is not as_numpy_1)
    found = loaded(tmp_path, raw)
    for array, expected in zip(found["arrays"], ARRAYS, strict=True):
        array = unwrap_array(array)  # noqa: PLW2901
        assert array.dtype == expected.dtype.newbyteorder("=") or array.dtype == expected.dtype
        np.testing.assert_array_equal(array, expected)
        assert not array.flags.writeable
    assert found["numbers"] == numbers
    assert {type(n) for n in found["numbers"]} == {float, int, bool}
    assert (found["text"], found["none"]) == ("größer", (None, True, False))


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_published_classes_become_records(tmp_path, protocol, kitti360pose_world):
    with kitti360pose_world.published() as module:
        thing = kitti360pose_world.made(module.Object3d, id=3, label="road", xyz=ARRAYS[0])
        raw = pickle.dumps([thing, thing], protocol=protocol)
    first, second = loaded(tmp_path, raw)
    assert first is second
    assert type(first) is Record
    assert (first.kind, first.fields["id"], first.fields["label"]) == ("Object3d", 3, "road")
    np.testing.assert_array_equal(unwrap_array(first.fields["xyz"]), ARRAYS[0])
    assert MODULE not in sys.modules, "nothing was imported"


CALLS = {
    "system": (os.system, "touch {}"),
    "eval": (builtins.eval, "open({!r}, 'w')"),
    "exec": (builtins.exec, "open({!r}, 'w')"),
    "open": (builtins.open, "{}", "w"),
    "getattr": (builtins.getattr, os, "system"),
    "import": (builtins.__import__, "os"),
    "mkdir": (os.mkdir, "{}"),
    "codec": (codecs.encode, "x", "rot13"),
    "decode": (codecs.decode, b"x", "rot13"),
    "bytearray": (bytearray, 1 << 40),
    "zeros": (np.zeros, 1 << 40),
    "ndarray": (np.ndarray, (1 << 40,)),
    "dtype": (np.dtype, "O"),
    "fields": (np.dtype, "f8,f8"),
    "reconstruct": (np._core.multiarray._reconstruct, dict, (0,), b"b"),
}


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("name", CALLS)
def test_calls_are_never_made(tmp_path, name, protocol):
    mark = tmp_path / "mark"
    function, *arguments = CALLS[name]
    if function is builtins.getattr:
        arguments = [Anything(builtins.__import__, "os"), "system"]  # a chain of calls
    arguments = [a.format(str(mark)) if isinstance(a, str) else a for a in arguments]
    for raw in (
        pickle.dumps(Anything(function, *arguments), protocol=protocol),
        pickle.dumps([{"id": Anything(function, *arguments)}], protocol=protocol),
    ):
        refused(tmp_path, raw)
    assert not mark.exists()


@pytest.mark.parametrize(
    "raw",
    [
        b"\x80\x04Nr\xff\xff\xff\xff.",  # Python's own would make room for four thousand million
        b"\x80\x04N" + b"r\xf0\xff\xff\xffj\xf0\xff\xff\xff0" * 50 + b".",
    ],
)
def test_a_huge_memo_costs_nothing(tmp_path, raw):
    path = stored(tmp_path, raw)
    tracemalloc.start()
    assert read_pickle(path, RELEASE) is None
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


def test_lengths_are_not_believed(tmp_path):
    for opcode in (b"B\xff\xff\xff\xff", b"\x8e" + b"\xff" * 8, b"\x96" + b"\xff" * 7 + b"\x0f",
                   b"X\xff\xff\xff\xff", b"\x8d" + b"\xff" * 8, b"\x8b\xff\xff\xff\x7f"):  # fmt: skip
        refused(tmp_path, b"\x80\x04" + opcode + b"abc.")


@pytest.fixture(scope="module")
def sound(kitti360pose_world):
    with kitti360pose_world.published() as module:
        thing = kitti360pose_world.made(module.Object3d, id=np.int32(3), xyz=np.eye(3), label="x")
        cell = kitti360pose_world.made(module.Cell, objects=[thing], bbox_w=np.arange(6.0))
        return {p: pickle.dumps([cell], protocol=p) for p in PROTOCOLS}


def test_every_cut_is_noticed(tmp_path, sound):
    for raw in sound.values():
        path = stored(tmp_path, raw)
        for end in reversed(range(len(raw))):
            os.truncate(path, end)
            with pytest.raises(InputError):
                read_pickle(path, RELEASE)


@given(st.data())
def test_damage_gives_data_or_a_sentence(tmp_path_factory, sound, data):
    raw = bytearray(sound[data.draw(st.sampled_from(PROTOCOLS))])
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.pkl"
    path.write_bytes(bytes(raw))
    try:
        read_pickle(path, RELEASE)
    except InputError as error:
        assert "nothing of it was run" in str(error)  # noqa: PT017
