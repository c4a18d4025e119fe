import struct
from types import SimpleNamespace

import numpy as np
import pytest
from tests.io.writers import rvl

from placegraph.errors import InputError
from placegraph_io.ros.decode import decode_colour, decode_depth, read_size
from placegraph_lab.worlds.bags import png

RNG = np.random.default_rng(0)
SMOOTH = np.stack(
    [np.add.outer(np.arange(12) * a, np.arange(16) * b) + 20 for a, b in ((3, 4), (5, 2), (2, 6))],
    axis=-1,
).astype(np.uint8)  # fmt: skip


def image(pixels, encoding, *, pad=0, big=0):
    rows = np.ascontiguousarray(pixels)
    data = rows.reshape(len(rows), -1).view(np.uint8)
    padded = np.pad(data, ((0, 0), (0, pad)), constant_values=7)
    return SimpleNamespace(
        height=rows.shape[0], width=rows.shape[1], encoding=encoding, step=padded.shape[1],
        is_bigendian=big, data=padded.reshape(-1),
    )  # fmt: skip


def packed(data, said):
    return SimpleNamespace(format=said, data=np.frombuffer(data, np.uint8))


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", SMOOTH), ("bgr8", SMOOTH[..., ::-1]), ("8UC3", SMOOTH[..., ::-1]),
        ("rgba8", np.dstack([SMOOTH, SMOOTH[..., :1]])),
        ("bgra8", np.dstack([SMOOTH[..., ::-1], SMOOTH[..., :1]])),
        ("rgb16", SMOOTH.astype("<u2") * 256 + 9),
    ],
)  # fmt: skip
def test_plain_colours(encoding, pixels):
    for pad in (0, 5):
        np.testing.assert_array_equal(decode_colour(image(pixels, encoding, pad=pad), "x"), SMOOTH)
    if encoding == "rgb16":
        turned = decode_colour(image(pixels.astype(">u2"), encoding, big=1), "x")
        np.testing.assert_array_equal(turned, SMOOTH)


def test_greys():
    grey = SMOOTH[..., 0]
    wanted = np.repeat(grey[..., None], 3, axis=2)
    np.testing.assert_array_equal(decode_colour(image(grey, "mono8"), "x"), wanted)
    np.testing.assert_array_equal(
        decode_colour(image(grey.astype("<u2") << 8, "mono16"), "x"), wanted
    )


@pytest.mark.parametrize("order", ["rggb", "grbg", "gbrg", "bggr"])
def test_bayer(order):
    raw = np.empty(SMOOTH.shape[:2], np.uint8)
    for i, letter in enumerate(order):
        y, x = divmod(i, 2)
        raw[y::2, x::2] = SMOOTH[y::2, x::2, "rgb".index(letter)]
    got = decode_colour(image(raw, f"bayer_{order}8"), "x")
    assert np.abs(got.astype(int) - SMOOTH)[1:-1, 1:-1].max() <= 1
    assert np.abs(got.astype(int) - SMOOTH).max() <= 8
    wide = decode_colour(image(raw.astype("<u2") << 8, f"bayer_{order}16"), "x")
    np.testing.assert_array_equal(wide, got)
    jpeg = decode_colour(packed(png(raw), f"bayer_{order}8; png compressed"), "x")
    np.testing.assert_array_equal(jpeg, got)


@pytest.mark.parametrize("encoding", ["yuv422", "yuv422_yuy2"])
def test_yuv(encoding):
    r, g, b = SMOOTH.astype(float).repeat(2, axis=1).transpose(2, 0, 1)  # pairs are of one colour
    y = 16 + 0.257 * r + 0.504 * g + 0.098 * b
    u = 128 - 0.148 * r - 0.291 * g + 0.439 * b
    v = 128 + 0.439 * r - 0.368 * g - 0.071 * b
    chroma = np.where(np.arange(r.shape[1]) % 2, v, u)
    pairs = (chroma, y) if encoding == "yuv422" else (y, chroma)
    got = decode_colour(image(np.rint(np.stack(pairs, axis=-1)).astype(np.uint8), encoding), "x")
    np.testing.assert_allclose(got, SMOOTH.repeat(2, axis=1), atol=3)


def test_depths():
    units = RNG.integers(200, 9000, (12, 16)).astype(np.uint16)
    units[0, 0] = 0
    metres = np.where(units, units / 1000, np.nan).astype(np.float32)
    unread = metres.copy()
    unread[0, 0], unread[0, 1] = -1.0, np.inf
    a, b = 30.0, -0.5  # of compressed_depth_image_transport
    inverse = np.where(units, np.rint(a / np.nan_to_num(metres, nan=1.0) + b), 0).astype(np.uint16)
    for said in (
        image(units, "16UC1", pad=6), image(units.astype(">u2"), "16UC1", big=1),
        image(metres, "32FC1"), packed(bytes(12) + png(units), "16UC1; compressedDepth png"),
        packed(png(units), "16UC1; png compressed "),
        packed(bytes(12) + rvl(units), "16UC1; compressedDepth rvl"),
    ):  # fmt: skip
        np.testing.assert_array_equal(decode_depth(said, None, "x"), metres)
        assert read_size(said, "x")[:2] == (16, 12)
    np.testing.assert_allclose(
        decode_depth(image(units, "16UC1"), 5000.0, "x"), metres / 5, rtol=1e-6
    )
    got = decode_depth(image(unread, "32FC1"), None, "x")
    assert np.isnan(got[0, :2]).all()
    head = struct.pack("<iff", 0, a, b)
    got = decode_depth(packed(head + png(inverse), "32FC1; compressedDepth"), None, "x")
    np.testing.assert_allclose(got, metres, rtol=0.2)
    np.testing.assert_allclose(got[inverse > 50], (a / (inverse - b))[inverse > 50], rtol=1e-6)


@pytest.mark.parametrize(
    ("said", "match"),
    [
        (image(SMOOTH, "rgb8"), "encoding 'rgb8' is not depth; record 16UC1"),
        (packed(png(SMOOTH), "16UC1; jpeg"), "mode 'RGB',.* not depth"),
        (packed(bytes(30), "16UC1; compressedDepth rvl"), "declares 0 x 0 pixels"),
        (packed(b"\x89PNG", "16UC1; compressedDepth png"), "cannot be read as an image"),
    ],
)
def test_what_is_no_depth(said, match):
    with pytest.raises(InputError, match=match):
        decode_depth(said, None, "x")
