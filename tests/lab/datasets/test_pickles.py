"""The machine for pickles: what is published is read, whatever else is refused, nothing is run."""

import builtins
import codecs
import io
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
from placegraph_lab.datasets.pickles import Record, finished
from placegraph_lab.datasets.pickles import read_pickle as read

MODULE = RELEASE.module


PROTOCOLS = (2, 3, 4, 5)
ARRAYS = [
    np.arange(12.0).reshape(4, 3),
    np.arange(12, dtype=np.float32).reshape(4, 3)[:, ::2],
    np.asfortranarray(np.arange(6).reshape(2, 3)),
    np.arange(5, dtype=">i2"),
    np.array([True, False]),
    np.zeros((0, 3)),
    np.array(2.5),
    np.arange(3, dtype=np.uint8),
]


def read_pickle(path, release=RELEASE):
    return read(path, release)


class Anything:
    """Pickles itself as the call of a function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def stored(tmp_path, raw):
    path = tmp_path / "x.pkl"
    path.write_bytes(raw)
    return path


def loaded(tmp_path, raw):
    return read_pickle(stored(tmp_path, raw))


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
    """The same pickle as numpy 1 writes it."""
    for name in ("multiarray", "numeric"):
        new, old = f"numpy._core.{name}".encode(), f"numpy.core.{name}".encode()
        raw = raw.replace(b"c" + new, b"c" + old)
        for tag, size in ((b"\x8c", "<B"), (b"X", "<I")):
            raw = raw.replace(
                tag + struct.pack(size, len(new)) + new, tag + struct.pack(size, len(old)) + old
            )
    return pickletools.optimize(raw)  # frames anew


# --- what is read ---


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("spelling", [lambda raw: raw, as_numpy_1])
def test_arrays_and_numbers_of_both_numpys(tmp_path, protocol, spelling):
    numbers = [np.float64(0.1), np.int32(-7), np.bool_(True), np.float32(0.5), 3, 1 << 70, 0.25]
    told = {"arrays": ARRAYS, "numbers": numbers, "text": "größer", "none": (None, True, False)}
    raw = spelling(pickle.dumps(told, protocol=protocol))
    assert (b"numpy._core" in raw) == (spelling is not as_numpy_1)
    found = loaded(tmp_path, raw)
    for array, expected in zip(found["arrays"], ARRAYS, strict=True):
        array = finished(array)  # noqa: PLW2901
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
    np.testing.assert_array_equal(finished(first.fields["xyz"]), ARRAYS[0])
    assert MODULE not in sys.modules, "nothing was imported"


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_single_array(tmp_path, protocol):
    np.testing.assert_array_equal(loaded(tmp_path, pickle.dumps(ARRAYS[0], protocol)), ARRAYS[0])


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 90), 1 << 90) | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8")),
    lambda inner: st.lists(inner, max_size=20)
    | st.dictionaries(st.text(max_size=5) | st.integers(-(1 << 90), 1 << 90), inner)
    | st.tuples(inner) | st.tuples(inner, inner, inner, inner),
    max_leaves=30,
)  # fmt: skip


@given(plain, st.sampled_from(PROTOCOLS))
def test_plain_data_come_back(tmp_path_factory, value, protocol):
    path = tmp_path_factory.getbasetemp() / "plain.pkl"
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    assert read_pickle(path) == value


# --- what is refused ---


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


def test_python_would_have_run_it(tmp_path):
    """The test above can fail: Python's own unpickler makes the file."""
    mark = tmp_path / "mark"
    raw = pickle.dumps(Anything(os.mkdir, str(mark)))
    refused(tmp_path, raw, "asks for")
    assert not mark.exists()
    pickle.loads(raw)  # noqa: S301
    assert mark.exists()


CELL = f"c{MODULE}\nCell\n".encode()
ENCODE = b"c_codecs\nencode\n"
BY_HAND = {
    "a function of the module": (f"c{MODULE}\nnp\n".encode(), "asks for"),
    "a path through a class": (f"c{MODULE}\nCell.__init__.__globals__\n".encode(), "asks for"),
    "another module": (b"cdatapreparation.kitti360pose.utils\nCell\n", "asks for"),
    "a class called": (CELL + b")R", "calls"),
    "a class with arguments": (CELL + b"K\x01\x85\x81", "makes an object"),
    "an instance called": (CELL + b")\x81)R", "calls"),
    "a function set": (ENCODE + b"}X\x0c\x00\x00\x00__defaults__Nsb", "state"),
    "a class set": (CELL + b"}X\x02\x00\x00\x00idNsb", "state"),
    "slots": (CELL + b")\x81N}\x86b", "is no dict"),
    "a field without a name": (CELL + b")\x81}K\x01K\x02sb", "no dict of fields"),
    "a string set": (b"X\x01\x00\x00\x00x}b", "state"),
    "keys that are no text": (b"}NK\x02s", "keys"),
    "another codec": (ENCODE + b"X\x01\x00\x00\x00xX\x05\x00\x00\x00utf-7\x86R", "codec"),
    "a codec of a number": (ENCODE + b"K\x05X\x06\x00\x00\x00latin1\x86R", "codec"),
    "no latin-1": (
        ENCODE + b"X\x03\x00\x00\x00\xe2\x82\xacX\x06\x00\x00\x00latin1\x86R", "text that is none"
    ),
    "an extension": (b"\x82\x01", "opcode"),
    "a persistent id": (b"K\x01Q", "opcode"),
    "an instance of old": (b"(ios\nsystem\n", "opcode"),
    "an object of old": (b"(" + CELL + b"o", "opcode"),
    "a buffer from elsewhere": (b"\x97", "opcode"),
    "a set": (b"\x8f", "opcode"),
    "keywords": (CELL + b")}\x92", "opcode"),
    "append to a number": (b"K\x01K\x02a", "list"),
    "an empty slot": (b"hA", "slot"),
    "an empty stack": (b"0", "stack"),
    "a mark too few": (b"t", "mark"),
    "a mark too many": (b"(N", "order"),
    "two values": (b"NN", "order"),
    "a dtype within": (
        b"cnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R(K\x03X\x01\x00\x00\x00<NXa\x00\x00\x00", "ends"
    ),
    "fields in a dtype": (
        b"cnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R(K\x03X\x01\x00\x00\x00<N)}K\x01K\x01K\x00tb",
        "plain numbers",
    ),
    "bytes of something": (b"c__builtin__\nbytes\nK\x05\x85R", "made of something"),
    "a long number": (b"\x8a\x20" + bytes(32), "longer"),
}  # fmt: skip


@pytest.mark.parametrize("name", BY_HAND)
def test_by_hand(tmp_path, name):
    raw, word = BY_HAND[name]
    refused(tmp_path, b"\x80\x04" + raw + b".", word)


def test_attributes_are_only_keys(tmp_path):
    """What is set on an instance never becomes an attribute, whatever it is called."""
    for key in ("__class__", "__dict__", "__setstate__", "kind", "fields"):
        text = pickle.dumps(key, protocol=3)[2:-1]
        record = loaded(tmp_path, b"\x80\x03" + CELL + b")\x81}" + text + b"K\x07sb.")
        assert (type(record), record.kind, record.fields) == (Record, "Cell", {key: 7})


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85C\x01b\x87R"
FLOATS = b"cnumpy\ndtype\nX\x02\x00\x00\x00f8\x85R"
STATES = {
    "shape larger than its bytes": b"(K\x01J\xff\xff\xff\x7f\x85" + FLOATS + b"\x89C\x08abcdefghtb",
    "negative": b"(K\x01J\xff\xff\xff\xff\x85" + FLOATS + b"\x89C\x08abcdefghtb",
    "empty and endless": (
        b"(K\x01(K\x00J\xff\xff\xff\x7fJ\xff\xff\xff\x7fJ\xff\xff\xff\x7ft"
        + FLOATS
        + b"\x89C\x00tb"
    ),
    "a list for bytes": b"(K\x01K\x01\x85" + FLOATS + b"\x89]tb",
    "no dtype": b"(K\x01K\x01\x85N\x89C\x08abcdefghtb",
    "a shape that is none": b"(K\x01]" + FLOATS + b"\x89C\x08abcdefghtb",
    "a short state": b"(K\x01tb",
}


@pytest.mark.parametrize("name", STATES)
def test_arrays_that_lie(tmp_path, name):
    refused(tmp_path, b"\x80\x03" + ARRAY + STATES[name] + b".", "array")


def test_an_array_is_filled_once(tmp_path):
    state = b"(K\x01K\x01\x85" + FLOATS + b"\x89C\x08abcdefghtb"
    assert loaded(tmp_path, b"\x80\x03" + ARRAY + state + b".").shape == (1,)
    refused(tmp_path, b"\x80\x03" + ARRAY + state + state + b".", "state")


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
    assert read_pickle(path) is None
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1_000_000


def test_lengths_are_not_believed(tmp_path):
    for opcode in (b"B\xff\xff\xff\xff", b"\x8e" + b"\xff" * 8, b"\x96" + b"\xff" * 7 + b"\x0f",
                   b"X\xff\xff\xff\xff", b"\x8d" + b"\xff" * 8, b"\x8b\xff\xff\xff\x7f"):  # fmt: skip
        refused(tmp_path, b"\x80\x04" + opcode + b"abc.")


def test_one_text_does_not_become_many(tmp_path):
    text = b"X" + struct.pack("<I", 100_000) + b"x" * 100_000 + b"q\x00"
    once = ENCODE + b"q\x01" + text + b"X\x06\x00\x00\x00latin1q\x02\x86R"
    assert loaded(tmp_path, b"\x80\x03" + once + b".") == b"x" * 100_000
    refused(tmp_path, b"\x80\x03]" + once + b"h\x01h\x00h\x02\x86R" * 99 + b".", "more bytes")


# --- damage ---


def test_files_that_are_none(tmp_path):
    for raw, word in ((b"", "empty"), (b"PK\x03\x04zip", "no pickle"), (b"\x80\x06N.", "no pickle"),
                      (b"(lp0\n.", "no pickle"), (b"\x80", "ends here")):  # fmt: skip
        refused(tmp_path, raw, word)
    with pytest.raises(InputError, match="cannot be read"):
        read_pickle(tmp_path / "missing.pkl")
    with pytest.raises(InputError, match="plain file"):
        read_pickle(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="plain file"):
        read_pickle(tmp_path / "pipe")


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
                read_pickle(path)


@given(st.data())
def test_damage_gives_data_or_a_sentence(tmp_path_factory, sound, data):
    raw = bytearray(sound[data.draw(st.sampled_from(PROTOCOLS))])
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.pkl"
    path.write_bytes(bytes(raw))
    try:
        read_pickle(path)
    except InputError as error:
        assert "nothing of it was run" in str(error)  # noqa: PT017


def test_frames_are_only_hints(tmp_path):
    raw = pickle.dumps(list(range(1000)), protocol=4)
    at = raw.index(b"\x95")
    assert loaded(tmp_path, raw[: at + 1] + bytes(8) + raw[at + 9 :]) == list(range(1000))


def test_the_default_unpickler_agrees(tmp_path, sound, kitti360pose_world):
    """The same bytes, read by Python's own in a world where the module exists."""
    with kitti360pose_world.published():
        (expected,) = pickle.load(io.BytesIO(sound[5]))  # noqa: S301
    (found,) = loaded(tmp_path, sound[5])
    np.testing.assert_array_equal(finished(found.fields["bbox_w"]), expected.bbox_w)
    assert found.fields["objects"][0].fields["id"] == expected.objects[0].id
