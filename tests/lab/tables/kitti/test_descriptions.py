import json
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import InputError
from placegraph_lab.tables.kitti.own_pairs import Description as Told
from placegraph_lab.tables.kitti.own_pairs import read_descriptions

SOUND = {"id": "a", "text": "A bakery is north of me.", "longitude": 7.42, "latitude": 43.73}


def written(tmp_path, *rows):
    path = tmp_path / "descriptions.jsonl"
    lines = [row if isinstance(row, str) else json.dumps(row) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_every_field(tmp_path):
    full = SOUND | {"id": 7, "heading_deg": 90, "near": [7.4, 43.7, 500], "text": "Ein Bäcker."}
    pair = SOUND | {"id": "c", "near": [7.4, 43.7], "heading_deg": None}
    found = read_descriptions(written(tmp_path, SOUND, "", full, pair))
    assert found == (
        Told("a", SOUND["text"], 7.42, 43.73),
        Told("7", "Ein Bäcker.", 7.42, 43.73, pytest.approx(pi / 2), (7.4, 43.7, 500.0)),
        Told("c", SOUND["text"], 7.42, 43.73, None, (7.4, 43.7)),
    )


def test_marks_and_line_ends_of_other_systems(tmp_path):
    path = written(tmp_path, SOUND)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert len(read_descriptions(path)) == 1


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("{", ["is not JSON"]),
        ("[" * 100_000, ["is not JSON"]),
        ("[1]", ["not an object"]),
        ({k: v for k, v in SOUND.items() if k != "text"}, ["text is missing"]),
        (SOUND | {"latitude": None}, ["latitude is missing"]),
        (SOUND | {"heading": 3}, ["no field 'heading'", "heading_deg"]),
        (SOUND | {"id": 1.5}, ["id is neither"]),
        (SOUND | {"id": ""}, ["id is neither"]),
        (SOUND | {"text": "  "}, ["text is empty"]),
        (SOUND | {"text": ["x"]}, ["text is empty, or no text"]),
        (SOUND | {"longitude": "7.42"}, ["longitude is '7.42', not a number"]),
        (SOUND | {"longitude": True}, ["longitude is 'True', not a number"]),
        (SOUND | {"longitude": 181}, ["longitude is 181", "-180 and 180"]),
        (SOUND | {"latitude": float("nan")}, ["latitude is nan"]),
        (SOUND | {"latitude": 743.73}, ["latitude is 743.73"]),
        (SOUND | {"longitude": 10**400}, ["longitude is a whole number; it lies between -180"]),
        (SOUND | {"heading_deg": "north"}, ["heading_deg is 'north'"]),
        (SOUND | {"near": [7.4]}, ["near is not [longitude"]),
        (SOUND | {"near": "7.4,43.7"}, ["near is not [longitude"]),
        (SOUND | {"near": [43.7, 143.7]}, ["near: latitude is 143.7"]),
        (SOUND | {"near": [7.4, 43.7, 0]}, ["near: radius is less"]),
        (SOUND | {"near": [7.4, 43.7, None]}, ["near: radius is 'None'"]),
        (SOUND, ["the id 'a' is taken"]),
    ],
)
def test_line_and_field_are_named(tmp_path, row, words):
    path = written(tmp_path, SOUND, "", row)
    with pytest.raises(InputError) as caught:
        read_descriptions(path)
    for word in (f"{path}, line 3", *words):
        assert word in str(caught.value)


def test_files_that_are_none(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_descriptions(tmp_path / "missing.jsonl")
    with pytest.raises(InputError, match="cannot be read"):
        read_descriptions(tmp_path)
    with pytest.raises(InputError, match="contains no description; write one a line"):
        read_descriptions(written(tmp_path, "", ""))
    path = written(tmp_path, SOUND)
    path.write_text(json.dumps(SOUND).replace("7.", "7" * 5000 + "."), encoding="utf-8")
    with pytest.raises(InputError, match="line 1"):
        read_descriptions(path)
    path = written(tmp_path, SOUND)
    path.write_bytes(path.read_bytes() + b'{"text": "B\xe4cker"}\n')
    with pytest.raises(InputError, match="line 2 is not UTF-8"):
        read_descriptions(path)


@given(st.text(max_size=60) | st.recursive(
    st.none() | st.floats() | st.text(max_size=4) | st.integers(),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.sampled_from([*SOUND, "near", "heading_deg"]), inner, max_size=6),
).map(json.dumps))  # fmt: skip
def test_any_line_gives_descriptions_or_a_sentence(tmp_path_factory, line):
    path = tmp_path_factory.getbasetemp() / "any.jsonl"
    path.write_text(line, encoding="utf-8", errors="replace")
    try:
        assert read_descriptions(path)
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017
