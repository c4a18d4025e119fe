import numpy as np
import pytest
from tests.indoor.mapping.parts import cuboid

from placegraph.core.graph import SceneGraph
from placegraph.indoor.language import TextIndex, rank_scenes, read
from placegraph.indoor.language.appearance import (
    COLOURS,
    KEY,
    colours_of,
    from_words,
    in_words,
    name_colours,
    with_colours,
)
from placegraph.indoor.language.likeness import match_labels
from placegraph.indoor.language.prior import Referents
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap


def room(*things):
    """Scene map of boxes: (label, centre, size, colour)."""
    labels, centres, sizes, colours = zip(*things, strict=True)
    half = np.array(sizes) / 2
    points, faces = zip(*map(cuboid, centres - half, centres + half), strict=True)
    faces = [f + 8 * k for k, f in enumerate(faces)]
    owner, colours = np.repeat(np.arange(len(labels)), 12), np.repeat(colours, 8, axis=0)
    mesh = Mesh.plain(np.concatenate(points), np.concatenate(faces), owner, colours)
    return SceneMap.create(mesh, list(map(str, range(len(labels)))), labels, floor=0.0)


GREEN, BLUE, BROWN, GREY = (40, 125, 60), (40, 90, 170), (107, 68, 38), (138, 138, 138)
FLOOR = ("floor", (2, 2, -0.05), (4, 4, 0.1), (244, 244, 242))
CORNER = room(
    FLOOR, ("couch", (0.5, 0.5, 0.4), (1, 1, 0.8), GREEN), ("table", (2, 2, 0.4), (1, 1, 0.8), GREY)
)
MIDDLE = room(
    FLOOR,
    ("couch", (2, 2, 0.4), (1, 1, 0.8), BLUE),
    ("table", (0.5, 3.5, 0.2), (0.5, 0.5, 0.4), BROWN),
)


@pytest.mark.parametrize(
    "text",
    [
        "a green sofa", "the settee is green", "a couch in the corner", "a table in the middle",
        "a steel table", "a large table", "a high table", "an olive couch",
    ],
)  # fmt: skip
def test_looks_tell_rooms_apart(text):
    first, second = rank_scenes(text, [CORNER, MIDDLE])
    assert first > second + 0.1
    bare = rank_scenes("a couch and a table", [CORNER, MIDDLE])
    assert bare[0] == pytest.approx(bare[1])


def test_what_a_map_does_not_know_says_nothing():
    graphs = [CORNER.graph, MIDDLE.graph]  # no colours
    first, second = rank_scenes("a green sofa", graphs)
    assert first == pytest.approx(second)
    annotated = TextIndex()
    for material in ("wooden, metal", "plastic"):
        annotated.add(SceneGraph(("0",), ("chair",), np.zeros((1, 3)), [], [], ()), (),
                      [{"material": material, "color": "white", "shape": "round"}])  # fmt: skip
    wooden = annotated.scores(read("a wooden chair"))
    assert wooden[0] > wooden[1] + 0.1
    assert np.ptp(annotated.scores(read("a round white chair"))) == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("text", "row"),
    [("next to the blue chair", 1), ("next to the big chair", 0), ("by a chair", -1)],
)
def test_the_thing_that_looks_so_is_meant(text, row):
    two = room(
        ("chair", (0, 0, 0.5), (0.8, 0.8, 1.0), GREEN),
        ("chair", (3, 0, 0.4), (0.4, 0.4, 0.8), BLUE),
    )
    (weights,) = Referents(read(text), two).weights
    assert weights.max() == pytest.approx(1.0)
    assert (weights < 0.9).tolist() == [row == 1, row == 0]


def test_rooms_have_sizes():
    small = room(("bed", (0, 0, 0.3), (2, 1, 0.6), GREY))
    assert np.diff(rank_scenes("a large room", [small, CORNER]))[0] > 0.1
    assert np.diff(rank_scenes("a small, narrow room with a bed", [CORNER, small]))[0] > 0.1


def test_colours_are_called_by_their_names():
    for name, code in (("red", (190, 30, 40)), ("black", (10, 10, 10)), ("beige", (216, 201, 168))):
        assert COLOURS[name_colours(np.array([code], np.uint8))[0].argmax()] == name
    shares = colours_of(CORNER)
    assert [COLOURS[i] for i in shares.argmax(axis=1)] == ["white", "green", "grey"]
    said = with_colours(CORNER)[1]
    assert said[KEY].startswith("green ")
    np.testing.assert_allclose(from_words(said), from_words({KEY: in_words(from_words(said))}))
    assert from_words({"color": "gray, white"})[COLOURS.index("grey")] > 0
    assert np.isnan(from_words({KEY: "mauve x 3"})).all()


@pytest.mark.parametrize(
    ("said", "label", "least"),
    [
        ("waste paper basket", "trash can", 0.9), ("bedside table", "nightstand", 0.9),
        ("duvet", "bed", 0.5), ("computer", "monitor", 0.5), ("tv bench", "tv stand", 0.9),
        ("black hot plates", "stove", 0.8), ("photographs", "picture", 0.9),
        ("chandelier", "lamp", 0.8), ("parquet", "floor", 0.9), ("zither", "bed", 0.0),
    ],
)  # fmt: skip
def test_everyday_words_fit_labels(said, label, least):
    (fit,) = match_labels(said, [label])
    assert fit >= least
    assert least or not fit
