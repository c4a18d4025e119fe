"""Names stand where there is room, and never on each other."""

from math import hypot

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from placegraph.view.draw.canvas import Area, Dot, Face, Line, face_for
from placegraph.view.draw.lettering import REPEAT, Taken, covering, letter

BUILT_IN = Face("")


class Names:
    """Just what lettering reads of a city's objects."""

    def __init__(self, *names):
        self.names = names

    def name(self, row):
        return self.names[row]


places = st.lists(st.tuples(st.integers(0, 300), st.integers(0, 300)), min_size=1, max_size=25)


@given(places)
def test_names_of_points_never_overlap(at):
    names = Names(*(f"Name {k}" for k in range(len(at))))
    items = [Dot(np.array(point, float), "food", k) for k, point in enumerate(at)]
    placed = letter(names, items, 1.0, BUILT_IN, Taken())
    discs = [covering(t, BUILT_IN.width(t.text, t.size), 1.0) for t in placed]
    for k, one in enumerate(discs):
        for other in discs[k + 1 :]:
            assert all(
                hypot(a[0] - b[0], a[1] - b[1]) >= a[2] + b[2] - 4.0 for a in one for b in other
            )


def test_a_lone_name_is_placed_beside_its_point():
    [text] = letter(Names("Café"), [Dot(np.zeros(2), "food", 0)], 1.0, face_for(["Café"]), Taken())
    assert (text.text, text.anchor, text.row) == ("Café", "l", 0)
    assert text.shift[0] > 4.0


def test_a_name_gives_way_to_what_is_taken():
    taken = Taken()
    taken.claim([(30.0, 0.0, 16.0)], force=True)
    [text] = letter(Names("Cafe"), [Dot(np.zeros(2), "food", 0)], 1.0, BUILT_IN, taken)
    assert text.anchor == "r"


def test_a_street_is_named_along_it_and_reads_from_the_left():
    for angle in np.linspace(0.0, 2.0 * np.pi, 13):
        line = np.array([(0.0, 0.0), (400.0 * np.cos(angle), 400.0 * np.sin(angle))])
        [text] = letter(Names("Long Street"), [Line([line], "street", 0)], 1.0, BUILT_IN, Taken())
        assert -np.pi / 2 - 1e-9 <= text.angle <= np.pi / 2 + 1e-9
        assert abs(np.sin(text.angle - angle)) < 1e-6


def test_a_long_street_is_named_again():
    line = np.array([(0.0, 0.0), (3000.0, 0.0)])
    texts = letter(Names("Long Street"), [Line([line], "street", 0)], 1.0, BUILT_IN, Taken())
    x = sorted(text.at[0] for text in texts)
    assert len(x) >= 3
    assert np.diff(x).min() >= REPEAT


def test_a_short_or_winding_street_is_not_named():
    short = np.array([(0.0, 0.0), (20.0, 0.0)])
    zigzag = np.array([(10.0 * k, 30.0 * (k % 2)) for k in range(40)])
    names = Names("A name too long", "A name too long")
    items = [Line([short], "street", 0), Line([zigzag], "street", 1)]
    assert letter(names, items, 1.0, BUILT_IN, Taken()) == []


def test_an_area_too_small_for_its_name_is_not_named():
    ring = np.array([(0.0, 0.0), (200.0, 0.0), (200.0, 100.0), (0.0, 100.0), (0.0, 0.0)])
    item = [Area([ring], "park", 0)]
    [text] = letter(Names("Park"), item, 1.0, BUILT_IN, Taken())
    assert np.allclose(text.at, (100.0, 50.0))
    assert letter(Names("Park"), item, 0.05, BUILT_IN, Taken()) == []


def test_small_things_are_named_only_on_large_maps():
    item = [Dot(np.zeros(2), "food", 0)]
    assert letter(Names("Cafe"), item, 0.2, BUILT_IN, Taken()) == []
    assert letter(Names("Cafe"), item, 2.0, BUILT_IN, Taken())


def test_faces_draw_what_they_can():
    assert BUILT_IN.drawable("Cafe 12") == "Cafe 12"
    assert BUILT_IN.drawable("Bäckerei Größe") == "Backerei Grosse"
    assert BUILT_IN.drawable("北京") == ""
    assert face_for(["plain"]) == BUILT_IN
    best = face_for(["Größe", "Łódź"])
    assert best.draws("Größe") or best == BUILT_IN
