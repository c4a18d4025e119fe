"""Drawing: clipping, letters, painting, sheets, styles."""

from itertools import pairwise, product
from math import hypot
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageColor

from placegraph.errors import InputError, OptionError
from placegraph.view.draw.canvas import (
    MAX_LETTERS,
    Area,
    Disc,
    Dot,
    Face,
    Frame,
    HeatLayer,
    Line,
    Stroke,
    Text,
    choose_face,
    clip_line,
    clip_ring,
    cut_dashes,
)
from placegraph.view.draw.lettering import REPEAT, OccupiedPlaces, covering_discs, place_names
from placegraph.view.draw.painter import (
    Sheet,
    colour_density,
    paint_picture,
    wrap_text,
    write_image,
)
from placegraph.view.draw.style import AREA, LINE, PAINTS, PALETTE, POINT, RULES, find_paint

BOUNDS = (0.0, 0.0, 100.0, 60.0)
coordinate = st.integers(-300, 300).map(float)
points = st.lists(st.tuples(coordinate, coordinate), min_size=2, max_size=8).map(np.array)


def length(line):
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def area(ring):
    x, y = ring.T
    return 0.5 * float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def within(line):
    low, high = np.reshape(BOUNDS, (2, 2))
    return ((line >= low - 1e-6) & (line <= high + 1e-6)).all()


@given(points)
def test_pieces_of_a_line_lie_within_and_no_length_inside_is_lost(line):
    pieces = clip_line(line, BOUNDS)
    assert all(len(piece) >= 2 and within(piece) for piece in pieces)
    t = (np.arange(4000) + 0.5) / 4000
    inside = 0.0
    for a, b in pairwise(line):
        samples = a + t[:, None] * (b - a)
        hit = (samples >= BOUNDS[:2]).all(axis=1) & (samples <= BOUNDS[2:]).all(axis=1)
        inside += hit.mean() * np.hypot(*(b - a))
    assert abs(sum(map(length, pieces)) - inside) < 2e-3 * length(line) + 1e-6


def test_a_line_inside_comes_back_whole_and_one_that_leaves_in_pieces():
    line = np.array([(1.0, 1.0), (50.0, 20.0), (99.0, 59.0)])
    [piece] = clip_line(line, BOUNDS)
    assert np.array_equal(piece, line)
    line = np.array([(10.0, 10.0), (10.0, 100.0), (20.0, 100.0), (20.0, 10.0)])
    one, other = clip_line(line, BOUNDS)
    assert one.tolist() == [[10.0, 10.0], [10.0, 60.0]]
    assert other.tolist() == [[20.0, 60.0], [20.0, 10.0]]


@given(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=8, unique=True))
def test_a_clipped_ring_lies_within_and_is_closed(corners):
    ring = clip_ring(np.array([*corners, corners[0]]), BOUNDS)
    if len(ring):
        assert within(ring)
        assert (ring[0] == ring[-1]).all()


@given(coordinate, coordinate, st.integers(1, 200), st.integers(1, 200))
def test_a_clipped_box_has_the_area_of_the_overlap(x, y, width, height):
    ring = np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)])
    low, high = np.maximum((x, y), BOUNDS[:2]), np.minimum((x + width, y + height), BOUNDS[2:])
    overlap = np.maximum(high - low, 0.0).prod()
    clipped = clip_ring(ring, BOUNDS)
    assert abs((area(clipped) if len(clipped) > 3 else 0.0) - overlap) < 1e-6


@given(
    st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=2, max_size=6),
    st.integers(1, 20),
    st.integers(1, 20),
)
def test_dashes_cover_their_share_of_a_line(points, drawn, blank):
    line = np.array(points, float)
    total = sum(map(length, cut_dashes(line, float(drawn), float(blank))))
    assert abs(total - length(line) * drawn / (drawn + blank)) <= drawn + blank


BUILT_IN = Face("")


class Names:
    """Just what lettering reads of a city's objects."""

    def __init__(self, *names):
        self.names = names

    def name(self, row):
        return self.names[row]


def named(items, *names, scale=1.0, taken=None, face=BUILT_IN):
    """Names placed on a map of these items."""
    return place_names(Names(*names), items, scale, face, taken or OccupiedPlaces())


CAFE = [Dot(np.zeros(2), "food", 0)]
places = st.lists(st.tuples(st.integers(0, 300), st.integers(0, 300)), min_size=1, max_size=25)


@given(places)
def test_names_of_points_never_overlap(at):
    items = [Dot(np.array(point, float), "food", k) for k, point in enumerate(at)]
    placed = named(items, *(f"Name {k}" for k in range(len(at))))
    discs = [covering_discs(t, BUILT_IN.width(t.text, t.size), 1.0) for t in placed]
    for k, one in enumerate(discs):
        for other in discs[k + 1 :]:
            assert all(
                hypot(a[0] - b[0], a[1] - b[1]) >= a[2] + b[2] - 4.0 for a in one for b in other
            )


def test_a_name_is_placed_beside_its_point_where_nothing_else_is():
    [text] = named(CAFE, "Café", face=choose_face(["Café"]))
    assert (text.text, text.anchor, text.row) == ("Café", "l", 0)
    assert text.shift[0] > 4.0
    taken = OccupiedPlaces()
    taken.claim([(30.0, 0.0, 16.0)], force=True)
    [text] = named(CAFE, "Cafe", taken=taken)
    assert text.anchor == "r"


def test_a_street_is_named_along_it_from_the_left_and_again_where_it_is_long():
    for angle in np.linspace(0.0, 2.0 * np.pi, 13):
        line = np.array([(0.0, 0.0), (400.0 * np.cos(angle), 400.0 * np.sin(angle))])
        [text] = named([Line([line], "street", 0)], "Long Street")
        assert -np.pi / 2 - 1e-9 <= text.angle <= np.pi / 2 + 1e-9
        assert abs(np.sin(text.angle - angle)) < 1e-6
    line = np.array([(0.0, 0.0), (3000.0, 0.0)])
    texts = named([Line([line], "street", 0)], "Long Street")
    x = sorted(text.at[0] for text in texts)
    assert len(x) >= 3
    assert np.diff(x).min() >= REPEAT


def test_a_short_or_winding_street_is_not_named():
    short = np.array([(0.0, 0.0), (20.0, 0.0)])
    zigzag = np.array([(10.0 * k, 30.0 * (k % 2)) for k in range(40)])
    items = [Line([short], "street", 0), Line([zigzag], "street", 1)]
    assert named(items, *["A name too long"] * 2) == []


def test_what_is_small_is_named_only_on_large_maps():
    ring = np.array([(0.0, 0.0), (200.0, 0.0), (200.0, 100.0), (0.0, 100.0), (0.0, 0.0)])
    item = [Area([ring], "park", 0)]
    [text] = named(item, "Park")
    assert np.allclose(text.at, (100.0, 50.0))
    assert named(item, "Park", scale=0.05) == []
    assert named(CAFE, "Cafe", scale=0.2) == []
    assert named(CAFE, "Cafe", scale=2.0)


def test_faces_draw_what_they_can_and_what_a_picture_has_room_for():
    assert BUILT_IN.drawable("Cafe 12") == "Cafe 12"
    assert BUILT_IN.drawable("Bäckerei Größe") == "Backerei Grosse"
    assert BUILT_IN.drawable("北京") == ""
    assert choose_face(["plain"]) == BUILT_IN
    best = choose_face(["Größe", "Łódź"])
    assert best.draws("Größe") or best == BUILT_IN
    face = Face("")
    assert face.drawable("a" * 100_000) == "a" * MAX_LETTERS
    assert face.width("ä" * 100_000, 12.0) == face.width("ä" * MAX_LETTERS, 12.0)


FRAME = Frame((0.0, 0.0), 2.0, 200, 120)


def color(name, *, dark=False):
    return ImageColor.getrgb(PALETTE[name][dark])


def at(image, east, north):
    x, y = FRAME.to_px(np.array([east, north]))
    return image.getpixel((int(x), int(y)))


def box(size):
    return np.array([(-size, -size), (size, -size), (size, size), (-size, size), (-size, -size)])


@pytest.mark.parametrize("dark", [False, True])
def test_an_area_with_a_hole(dark):
    image = paint_picture([Area([box(25.0), box(10.0)], "park")], FRAME, dark=dark)
    assert image.size == (200, 120)
    assert at(image, 0.0, 0.0) == color("land", dark=dark)
    assert at(image, 18.0, 0.0) == color("park", dark=dark)
    assert at(image, 40.0, 0.0) == color("land", dark=dark)


def test_layers_do_not_follow_the_order_of_the_list_and_junctions_are_open():
    road = Line([np.array([(-40.0, 0.0), (40.0, 0.0)])], "street")
    image = paint_picture([road, Area([box(25.0)], "park")], FRAME)
    assert at(image, 0.0, 0.0) == color("road")
    one = Line([np.array([(-40.0, 0.0), (40.0, 0.0)])], "street")
    other = Line([np.array([(0.0, -40.0), (0.0, 40.0)])], "service")
    image = paint_picture([one, other], FRAME)
    assert {at(image, 0.0, y) for y in np.arange(-4.0, 4.1, 0.5)} == {color("road")}


def test_points_of_every_form_are_painted():
    for paint in ("food", "transit", "health", "tree"):
        image = paint_picture([Dot(np.zeros(2), paint)], FRAME)
        assert at(image, 0.0, 0.0) != color("land")


def test_marks_are_painted():
    marks = [
        Stroke(box(20.0), "for", 3.0, fill=0.5),
        Disc(np.array([40.0, 0.0]), 8.0, "mode", text="1"),
        Text(np.array([0.0, 0.0]), "NAME", 24.0, "against"),
        Text(np.array([-40.0, 0.0]), "TURNED", 24.0, "against", angle=1.2),
    ]
    image = paint_picture(marks, FRAME)
    assert at(image, 20.0, 5.0) == color("for")
    colors = {c for _, c in image.getcolors(100_000)}
    assert {color("mode"), color("against"), color("on-mode")} <= colors


def test_heat_grows_with_density():
    opacity = np.asarray(colour_density(np.linspace(0.0, 1.0, 50)[None]))[0, :, 3].astype(int)
    assert opacity[0] == 0
    assert (np.diff(opacity) >= 0).all()
    assert opacity[-1] > 120
    glow = HeatLayer(np.ones((4, 4)), (-10.0, -10.0, 10.0, 10.0))
    image = paint_picture([glow], FRAME)
    assert at(image, 0.0, 0.0) != color("land") == at(image, 30.0, 0.0)


@given(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.integers(50, 900), st.integers(50, 900))
def test_a_frame_shows_its_bounds(west, south, width, height):
    frame = Frame.around((west, south, west + 120.0, south + 80.0), width, height)
    w, s, e, n = frame.bounds
    assert max(w - west, s - south, west + 120.0 - e, south + 80.0 - n) <= 1e-6
    assert np.allclose(frame.to_px(np.array([w, n])), 0.0, atol=1e-6)


def test_of_a_dashed_line_beyond_the_picture_only_what_is_seen_is_cut():
    line = Stroke(np.array([(-1e12, 0.0), (1e12, 0.0)]), "for", 3.0, (5.0, 4.0))
    image = paint_picture([line], FRAME)
    row = [at(image, x, 0.0) == color("for") for x in np.linspace(-49.0, 49.0, 200)]
    assert 0.4 < np.mean(row) < 0.7


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full: a disk without room")
def test_a_full_disk_is_told_with_the_name_of_the_file():
    with pytest.raises(InputError, match="/dev/full"):
        Sheet(40, 30).save("/dev/full")


@pytest.mark.parametrize(("name", "form"), [("plan.JPG", "PNG"), ("plan.png", "GIF")])
def test_the_ending_of_another_kind_of_picture_is_refused(name, form, tmp_path):
    with pytest.raises(OptionError, match=f"{name}.* use the ending .{form.lower()}"):
        write_image(Image.new("RGB", (4, 3)), tmp_path / name, form)
    assert not list(tmp_path.iterdir())
    write_image(Image.new("RGB", (4, 3)), tmp_path / "plan", form)


def test_a_line_is_cut_to_its_room_by_few_looks_at_it(monkeypatch):
    sheet, looks, width = Sheet(400, 30), [], Face.width
    monkeypatch.setattr(Face, "width", lambda *given: looks.append(given) or width(*given))
    short, whole = (
        sheet.text((0, 9), t, 12.0, "ink", room=300.0) for t in ("word " * 6, "word " * 9999)
    )
    assert short < 280.0 < whole <= 300.0
    assert len(looks) < 40


def luminance(color):
    def linear(channel):
        c = channel / 255
        return c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4

    red, green, blue = (linear(c) for c in ImageColor.getrgb(color)[:3])
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(a, b):
    dark, light = sorted((luminance(a), luminance(b)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize(
    ("labels", "kind", "paint"),
    [
        (["shop=bakery"], POINT, "shop"), (["shop=never_heard_of"], POINT, "shop"),
        (["amenity=cafe", "name=*"], POINT, "food"),
        (["highway=secondary", "bridge=yes"], LINE, "main-road"),
        (["highway=never_heard_of"], LINE, "street"),
        (["amenity=school", "building=school"], AREA, "building"),
        (["amenity=school"], AREA, "grounds"),
        (["amenity=place_of_worship", "building=church"], AREA, "landmark"),
        (["leisure=park"], AREA, "park"), (["boundary=administrative"], AREA, ""), ([], POINT, ""),
    ],
)  # fmt: skip
def test_paint_of(labels, kind, paint):
    assert find_paint(labels, kind) == paint


def test_rules_name_paints_of_their_kind_which_use_the_palette():
    forms = {AREA: {"area"}, LINE: {"line"}, POINT: {"crown", "disc", "square", "cross"}}
    for kind, rules in RULES.items():
        for line in rules.splitlines():
            if line and not line.startswith(" "):
                assert PAINTS[line.split()[0]].form in forms[kind]
    for paint in PAINTS.values():
        assert {paint.fill, paint.ink, paint.edge or paint.fill} <= PALETTE.keys()
    for colors in PALETTE.values():
        assert all(ImageColor.getrgb(color) for color in colors)


@pytest.mark.parametrize("dark", [False, True])
def test_lettering_has_contrast(dark):
    inks = ("ink", "soft-ink", "for", "against", "mode", "amber", "park-ink")
    for ink, ground in (*product(inks, ("paper", "land")), ("on-mode", "mode")):
        assert contrast(PALETTE[ink][dark], PALETTE[ground][dark]) >= 4.5, (ink, ground)


@given(st.lists(st.text("abcdefgh", min_size=1, max_size=12), min_size=1), st.integers(80, 400))
def test_lines_break_between_words_and_say_what_they_leave_out(words, room):
    text, face = " ".join(words), choose_face(["a"])
    lines = wrap_text(face, text, 13, room, 2)
    assert len(lines) <= 2
    assert all(face.width(line, 13) <= room for line in lines)
    shown = [word for line in lines for word in line.removesuffix("...").split()]
    whole = max(face.width(word, 13) for word in words) <= room - face.width("...", 13)
    assert not whole or shown == words[: len(shown)]
    assert lines[-1].endswith("...") == ("".join(shown) != "".join(words))
