import bz2
import io
import json
import zipfile
import zlib

import numpy as np
import pytest
from PIL import Image

from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import PlacegraphError
from placegraph_lab.campaign.mutate import mutate_bytes, mutate_path

TIMES = 60
XML = b"<osm>\n<node id='1' lat='50.0'/>\n<tag k='name' v='Kern'/>\n</osm>"


def png():
    out = io.BytesIO()
    Image.new("RGB", (9, 9), (3, 4, 5)).save(out, "PNG")
    return out.getvalue()


def zipped():
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("a.txt", "1 2 3\n")
        archive.writestr("b.json", "[1]")
    return out.getvalue()


SAMPLES = {
    "a.png": png(), "a.zip": zipped(), "a.json": b'{"a": [1, 2.5, {"b": "c"}]}', "a.osm": XML,
    "a.osm.bz2": bz2.compress(XML), "a.txt": b"1 2 3\n4 5 6\n", "a.bin": bytes(range(99)),
}  # fmt: skip


@pytest.mark.parametrize("name", SAMPLES)
def test_a_number_tells_an_input(name):
    first = [mutate_bytes(SAMPLES[name], name, np.random.default_rng(i)) for i in range(TIMES)]
    again = [mutate_bytes(SAMPLES[name], name, np.random.default_rng(i)) for i in range(TIMES)]
    if name != "a.zip":  # it holds the time
        assert first == again
    assert len(set(first)) > TIMES // 3
    assert sum(made == SAMPLES[name] for made in first) < TIMES // 4


def test_images_are_wrong_behind_their_checksums():
    told = set()
    for i in range(TIMES):
        data = mutate_bytes(SAMPLES["a.png"], "a.png", np.random.default_rng(i))
        length = int.from_bytes(data[8:12], "big")
        head = data[12 : 16 + length]
        if head[:4] == b"IHDR" and int.from_bytes(
            data[16 + length : 20 + length], "big"
        ) == zlib.crc32(head):
            told.add(head)
    assert len(told) > 5


def test_stores_are_wrong_behind_their_checksums(tmp_path):
    path, opened = tmp_path / "a.city", []
    for i in range(TIMES):
        write_map(path, "city", 1, {"a": [1, 2]}, {"ids": np.arange(30), "at": np.ones((5, 2))})
        mutate_path(path, np.random.default_rng(i))
        try:
            held = read_map(path, "city", 1)
        except PlacegraphError:
            continue
        opened.append(
            json.dumps(held.meta) + "".join(a.tobytes().hex() for a in held.arrays.values())
        )
    assert len(set(opened)) > TIMES // 3
