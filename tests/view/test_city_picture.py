"""Pictures of a city and of estimates in it."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageColor

from placegraph.core.estimate import CityEstimate, Evidence, ObjectRef, Place, Status
from placegraph.core.geojson import contains_points
from placegraph.demo.town import TOWN, unpack
from placegraph.errors import OptionError
from placegraph.outdoor.city import build_city
from placegraph.view import draw_city, write_picture
from placegraph.view.city.city_items import (
    SIGMAS,
    competing_modes,
    ellipse,
    evidence_marks,
    evidence_objects,
    find_row,
    find_sea,
    mode_bounds,
    mode_position,
    posterior_layer,
    round_corners,
)
from placegraph.view.city.page import MAX_LEVEL, SIDE, UNIT, CityTiles, example_sentences
from placegraph.view.city.picture import length_words, round_length
from placegraph.view.draw.canvas import Disc, Stroke
from placegraph.view.draw.style import LAYER, PAINTS, PALETTE
from placegraph_lab.worlds.town.town import Town

BOUNDS = (0.0, 0.0, 1000.0, 1000.0)


def objects(*lines, labels=("natural=coastline", "building=yes"), built=()):
    """Just what `find_sea` reads of a city's objects: coastlines, and a city that fills the bounds."""
    center = np.repeat([(0.0, 0.0), (1000.0, 1000.0)], 500, axis=0)
    center[len(lines) : len(lines) + len(built)] = np.reshape(built, (-1, 2))
    coast = len(lines)
    lines = [np.array(line, np.float32) for line in [*lines, *([at, at] for at in built)]]
    return SimpleNamespace(
        labels=labels,
        kind=np.array([2 if (line[0] == line[-1]).all() else 1 for line in lines]),
        label_starts=np.arange(len(lines) + 1),
        label_values=(np.arange(len(lines)) >= coast).astype(np.int64),
        parts=lambda row: [lines[row]],
        center=center,
    )


def ring(west, south, east, north):
    """Ring with its inside on the left."""
    return [(west, south), (east, south), (east, north), (west, north), (west, south)]


@pytest.mark.parametrize(
    ("lines", "points", "wet"),
    [
        ([[(500, -50), (500, 1050)]], [(900, 500), (100, 500)], [True, False]),
        ([[(500, 1050), (500, -50)]], [(900, 500), (100, 500)], [False, True]),
        # pieces are joined in any order
        (
            [[(500, 300), (500, 700)], [(500, 700), (500, 1100)], [(500, -100), (500, 300)]],
            [(900, 50), (900, 950), (100, 500)], [True, True, False],
        ),
        # an island
        ([ring(400, 400, 600, 600)], [(500, 500), (100, 100), (900, 500)], [False, True, True]),
        # a bay and an island in it
        (
            [[(-10, 700), (700, 700), (700, 300), (-10, 300)], ring(200, 450, 300, 550)],
            [(100, 500), (250, 500), (500, 100), (900, 500)], [True, False, False, False],
        ),
        # a coast that the extract cut off goes straight on
        ([[(500, 200), (520, 800)]], [(900, 100), (900, 900), (100, 100)], [True, True, False]),
        # two shores of a strait
        (
            [[(1050, 300), (-50, 300)], [(-50, 700), (1050, 700)]],
            [(500, 500), (500, 100), (500, 900)], [True, False, False],
        ),
    ],
)  # fmt: skip
def test_the_sea_lies_right_of_the_coast(lines, points, wet):
    rings = find_sea(objects(*lines), BOUNDS)
    assert contains_points(np.array(points, np.float64), rings).tolist() == wet


def test_without_a_coast_or_with_one_that_contradicts_itself_there_is_no_sea():
    assert find_sea(objects([(0, 0), (1, 1)], labels=("natural=tree",)), BOUNDS) == []
    assert find_sea(objects([(500, -50), (500, 1050)], [(700, -50), (700, 1050)]), BOUNDS) == []


def test_no_sea_covers_buildings_where_a_coast_ends_on_the_map():
    coast = [(300, -50), (300, 400), (350, 420)]
    assert find_sea(objects(coast), BOUNDS)
    assert find_sea(objects(coast, built=[(100, 100), (700, 800)]), BOUNDS) == []
    assert find_sea(objects(coast, built=[(100, 100), (200, 300)]), BOUNDS)


def test_ellipse_holds_the_stated_deviations(city, sure):
    mode = sure.modes[0]
    delta = ellipse(city, mode) - mode_position(city, mode)
    mahalanobis = np.einsum("ni,ij,nj->n", delta, np.linalg.inv(mode.covariance), delta)
    assert np.allclose(np.sqrt(mahalanobis), SIGMAS)


def test_heat_peaks_at_the_heaviest_mode(city, sure):
    mode = mode_position(city, sure.modes[0])
    bounds = (*(mode - 80.0).tolist(), *(mode + 80.0).tolist())
    glow = posterior_layer(city, sure, bounds, 2.0)
    assert glow.density.shape == (80, 80)
    row, column = np.unravel_index(np.argmax(glow.density), glow.density.shape)
    peak = np.array([bounds[0] + (column + 0.5) * 2.0, bounds[3] - (row + 0.5) * 2.0])
    assert np.hypot(*(peak - mode)) < 4.0
    assert 0.5 < glow.density.max() <= 1.0 + 1e-9


def test_a_faint_posterior_is_faint_and_nothing_glows_far_away(city, sure, estimate_of):
    assert posterior_layer(city, sure, (9000.0, 9000.0, 9100.0, 9100.0), 2.0) is None
    faint = estimate_of(Status.LOST, 0.01)
    bounds = mode_bounds(city, faint.modes[0])
    assert posterior_layer(city, faint, bounds, 2.0).density.max() < 0.1


def test_witnesses_are_the_objects_of_telling_statements(city, sure, town):
    seen = evidence_objects(city, sure.modes[0])
    assert [w.verdict for w in seen] == ["for", "against"]
    assert seen[0].words == '<script>alert("K")</script>'
    here = mode_position(city, sure.modes[0])
    bakery = city.plane.to_plane(town.position("K"))
    assert np.allclose(seen[0].at, bakery, atol=1.0)
    # the church is an area: its nearest corner, not its centre
    assert np.hypot(*(seen[1].at - here)) < np.hypot(*(seen[1].middle - here))


def test_marks_join_witnesses_to_the_mode(city, sure):
    mode = sure.modes[0]
    marks = evidence_marks(city, mode)
    at = mode_position(city, mode)
    joined = [m for m in marks if isinstance(m, Stroke) and np.allclose(m.points[0], at)]
    assert {(m.color, m.dash is None) for m in joined} == {("for", True), ("against", False)}
    assert sum(isinstance(m, Disc) for m in marks) == 2
    way = at + np.array([(60.0, 0.0), (30.0, 0.0), (0.0, 0.0)])
    marks = evidence_marks(city, mode, way)
    assert marks[0].points is way
    joined = [
        m.points[0].tolist() for m in marks[1:] if isinstance(m, Stroke) and len(m.points) == 2
    ]
    assert all(begin in way.tolist() for begin in joined)


def test_ids_lead_to_their_rows(city):
    rows = list(range(len(city.objects)))
    assert [find_row(city.objects, city.objects.osm(i)) for i in rows] == rows
    for unknown in ("", "way", "way/", "way/-1", "star/1", "node/999999999"):
        assert find_row(city.objects, unknown) == -1


def test_rivals_are_about_as_probable(estimate_of):
    estimate = estimate_of(Status.AMBIGUOUS, 0.5, 0.3, 0.02)
    assert len(competing_modes(estimate, 4)) == 2
    assert len(competing_modes(estimate, 1)) == 1
    assert competing_modes(estimate_of(Status.LOST), 4) == ()


@pytest.fixture(scope="module")
def tiles(city):
    return CityTiles(city)


def shapes(tile):
    """Paint, id and parts of every shape of a tile."""
    return [
        (layer["paint"], osm, parts)
        for layer in tile["layers"]
        for osm, parts in zip(layer["osm"], layer["shapes"], strict=True)
    ]


def test_the_finest_level_has_every_object_that_is_painted(city, tiles):
    found = set()
    for key in tiles.within(tiles.bounds, 0):
        found |= {osm for _, osm, _ in shapes(tiles.tile(*key)) if osm}
    painted = {city.objects.osm(i) for i in range(len(city.objects)) if tiles._paints[i]}
    assert found == painted


def test_points_come_back_to_half_a_metre(city, tiles):
    [row] = [i for i in range(len(city.objects)) if city.objects.label(i) == "amenity=fountain"]
    for level, x, y in tiles.within(tiles.bounds, 0):
        for _, osm, parts in shapes(tiles.tile(level, x, y)):
            if osm == city.objects.osm(row):
                at = np.array(parts[0]) * UNIT + np.array([x, y]) * SIDE
                assert np.abs(at - city.objects.center[row]).max() <= UNIT / 2 + 1e-3


def test_layers_lie_in_painters_order_and_are_known(tiles):
    paints = [layer["paint"] for layer in tiles.tile(0, 0, 0)["layers"]]
    assert [LAYER[p] for p in paints] == sorted(LAYER[p] for p in paints)
    assert set(paints) <= set(tiles.index()["paints"]) == set(PAINTS)


def test_coarser_levels_have_less_in_them(shared, tmp_path):
    source = shared / "data" / "osm" / "toronto_downtown_2020.osm.bz2"
    tiles = CityTiles(build_city(source, tmp_path / "toronto.city"))
    counts = [
        sum(len(part) for key in tiles.within(tiles.bounds, level)
            for _, _, parts in shapes(tiles.tile(*key)) for part in parts)
        for level in range(tiles.top + 1)
    ]  # fmt: skip
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < 0.9 * counts[0]
    assert len(tiles.within(tiles.bounds, tiles.top)) <= 4
    small = [PAINTS[p].since > 1.5 * MAX_LEVEL / 2**tiles.top
             for p, _, _ in shapes(tiles.tile(tiles.top, 0, 0))]  # fmt: skip
    assert not any(small)


def test_examples_are_found_where_they_are_true(tmp_path):
    world = unpack(tmp_path)
    city = build_city(world / f"{TOWN}.osm", tmp_path / "town.city")
    said = example_sentences(city, CityTiles(city)._paints)
    assert len(said) == 3
    for text in said:
        estimate = city.locate(text)
        assert estimate.modes
        assert not estimate.understood.ignored


def test_examples_say_what_people_say(tmp_path):
    drawn = (
        "[town]\nname = Small\ncenter = 7.42 43.73\n\n[drawing]\n"
        "   A   \n" + 8 * "       \n" + "   G   \n\n[legend]\nA: shop=alcohol\nG: shop=gift\n"
    )
    source = Town.parse(drawn).write_osm(tmp_path / "small.osm")
    city = build_city(source, tmp_path / "small.city")
    said = "A liquor store is north of me and a gift shop is to the south."
    assert said in example_sentences(city, CityTiles(city)._paints)


def colors(image):
    return {color for _, color in image.convert("RGB").getcolors(1 << 24)}


@pytest.mark.parametrize("size", [(640, 480), (400, 700)])
def test_a_picture_of_every_status(city, estimate, size, tmp_path):
    path = write_picture(city, estimate, tmp_path / "here.png", size=size)
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert image.size == size
        seen = colors(image)
    assert len(seen) > 200
    assert ImageColor.getrgb(PALETTE["mode"][0]) in seen
    assert path.stat().st_size < 1_000_000


def test_evidence_is_drawn_in_its_colours_and_the_same_again(city, sure, tmp_path):
    with Image.open(write_picture(city, sure, tmp_path / "here.png")) as image:
        pixels = np.asarray(image.convert("RGB"))[70:850]
    for verdict in ("for", "against"):
        color = ImageColor.getrgb(PALETTE[verdict][0])
        assert (pixels == color).all(axis=2).sum() > 60
    one = write_picture(city, sure, tmp_path / "one.png", size=(400, 400)).read_bytes()
    assert one == write_picture(city, sure, tmp_path / "two.png", size=(400, 400)).read_bytes()


def test_names_that_no_face_draws_do_no_harm(tmp_path):
    town = Town.parse("[drawing]\nB\n[legend]\nB: shop=bakery name=\U00012000\U00012001\n")
    city = build_city(town.write_osm(tmp_path / "one.osm"), tmp_path / "one.city")
    longitude, latitude = town.position("B")
    ref = ObjectRef("node/1", "shop=bakery", "\U00012000\U00012001", longitude, latitude)
    evidence = (Evidence("a bakery", "for", 1.0, (ref,)),)
    mode = Place(longitude, latitude - 3e-4, 0.9, "", np.eye(2), explain=lambda: evidence)
    estimate = CityEstimate(Status.OK, (mode,), "Here.")
    with Image.open(write_picture(city, estimate, tmp_path / "one.png")) as image:
        assert ImageColor.getrgb(PALETTE["for"][0]) in colors(image)


def test_a_city(city, tmp_path):
    with Image.open(draw_city(city, str(tmp_path / "city.png"), size=(500, 400))) as image:
        assert image.size == (500, 400)
        assert ImageColor.getrgb(PALETTE["water"][0]) in colors(image)
        assert ImageColor.getrgb(PALETTE["park"][0]) in colors(image)


@pytest.mark.parametrize("size", [(10, 10), (400, 10_000), (400.0, 400), (400,)])
def test_sizes_out_of_range_are_refused(city, sure, size, tmp_path):
    with pytest.raises(OptionError, match="width and height from 320 to 6000"):
        write_picture(city, sure, tmp_path / "x.png", size=size)
    with pytest.raises(OptionError):
        draw_city(city, tmp_path / "x.png", size=size)
    assert not (tmp_path / "x.png").exists()


@given(st.floats(0.01, 1e5))
def test_scale_bars_are_round(most):
    length = round_length(most)
    assert most / 2.5001 <= length <= most * (1 + 1e-9)
    assert f"{length:.0e}"[0] in "125"


def test_lengths_in_words():
    assert [length_words(m) for m in (0.5, 20.0, 2000.0)] == ["0.5 m", "20 m", "2 km"]


def _polygon(n, radius):
    turn = np.linspace(0.0, 2.0 * np.pi, n + 1)
    return radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)


@pytest.mark.parametrize("n", [5, 6, 8])
@pytest.mark.parametrize("way", [1, -1])
def test_a_pool_that_a_map_simplified_is_drawn_round(n, way):
    ring = _polygon(n, 4.0)[::way]
    drawn = round_corners(ring)
    assert (drawn[0] == drawn[-1]).all()
    sides = 0.5 * (drawn[1:] + drawn[:-1])  # halfway between two points a polygon is flattest
    assert np.abs(np.hypot(*sides.T) - 4.0).max() < 0.1 * 4.0
    assert np.hypot(*(0.5 * (ring[1:] + ring[:-1])).T).min() < np.hypot(*sides.T).min()


@pytest.mark.parametrize(
    "ring", [_polygon(4, 4.0), _polygon(6, 30.0), np.array(ring(0, 0, 8, 8))[[0, 1, 1, 2, 3, 4]]]
)
def test_other_rings_are_drawn_as_they_are(ring):
    assert round_corners(ring) is ring
