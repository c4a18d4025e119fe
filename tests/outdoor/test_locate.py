import itertools
import json
import math
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.estimate import Status
from placegraph.errors import DescriptionError, OptionError
from placegraph.maps import open_map
from placegraph.outdoor.language.description import Description, Mention, Relation, Sense, Statement

TEXT = "I am next to a bench. A bakery is north of me."

# Sentences written by hand over the drawing of hafenstadt.txt: text, row and column of the truth.
HARBOUR = [
    ("I am on the Fischmarkt. The fountain is west of me, the Kaffeekontor is east.", 30, 59),
    ("I'm on Speicherweg, and the museum is south of me.", 35, 31),
    ("I am on Speicherweg. The bank is north of me.", 35, 37),
    ("I am at a tram stop. There are trees south of me and a church to the south-east.", 11, 23),
    ("I'm in the Stadtpark. A playground is west of me and a fountain is to the east.", 13, 76),
    ("A bookshop is west of me, and I am standing on Gartenweg.", 5, 67),
    ("I'm on Lange Straße, with the pharmacy to my north.", 8, 46),
    ("I am near the kindergarten, on Speicherweg.", 35, 69),
    ("I'm standing on Hafenstraße, south of the pub.", 26, 54),
    ("I'm in the cemetery, and the chapel is to my north.", 33, 9),
    ("I'm on Lange Straße. A bakery is north of me, a tram stop is south of me.", 8, 25),
]

# Written over what stands around these places in the extract of 2025: longitude and latitude.
MONACO = [
    (("I am on Place d'Armes. An ice cream shop and a kiosk are west of me, a pizza restaurant is "
      "north of me and a playground is to the south."), 7.41955, 43.73270),
    (("The museum is southwest of me, a bus stop is north-east of me. There is a memorial to the "
      "north and bicycle parking next to me. A kiosk is east of me."), 7.42560, 43.73100),
    ("I stand on Place du Casino, in front of the casino, next to a fountain.", 7.4278, 43.7393),
    ("I'm on the stairs of Escalier Sainte-Dévote. The chapel is north-east.", 7.4209, 43.7373),
    (("I'm on a parking lot next to a police station. The Boulevard du Jardin Exotique is east of "
      "me and a garden lies to the south-east."), 7.41340, 43.73150),
]  # fmt: skip


def metres(city, mode, lonlat):
    here, there = city.plane.to_plane((mode.longitude, mode.latitude)), city.plane.to_plane(lonlat)
    return float(np.hypot(*(here - there)))


def sound(estimate, city):
    """Check what every estimate promises."""
    probabilities = [mode.probability for mode in estimate.modes]
    assert probabilities == sorted(probabilities, reverse=True)
    assert sum(probabilities) <= 1 + 1e-6
    assert estimate.reason
    for mode in estimate.modes:
        assert 0 <= mode.probability <= 1
        assert np.linalg.eigvalsh(mode.covariance).min() > 0
        assert mode.cell in city.cells
        for evidence in mode.evidence:
            assert evidence.verdict in ("for", "against", "silent")
            assert math.isfinite(evidence.weight)
            assert evidence.statement
    assert estimate.best is (estimate.modes[0] if estimate.modes else None)
    assert estimate.support.shape[1] == 3
    assert np.isfinite(estimate.support).all()
    assert estimate.support[:, 2].sum() <= 1 + 1e-6
    json.dumps(estimate.to_dict())


@pytest.mark.parametrize(("text", "row", "column"), HARBOUR)
def test_places_in_the_harbour(text, row, column, harbour, hafenstadt):
    estimate = harbour.locate(text)
    sound(estimate, harbour)
    assert estimate.status == Status.OK
    assert estimate.best.probability > 0.5
    assert metres(harbour, estimate.best, hafenstadt.lonlat(row + 0.5, column + 0.5)) < 20
    assert all(e.verdict == "for" for e in estimate.evidence), "all was true"


@pytest.mark.parametrize(("text", "longitude", "latitude"), MONACO)
def test_places_in_monaco(text, longitude, latitude, monaco):
    estimate = monaco.locate(text)
    sound(estimate, monaco)
    assert estimate.status == Status.OK
    assert metres(monaco, estimate.best, (longitude, latitude)) < 30


def test_a_wrong_direction_does_not_lose_the_place(monaco):
    text, longitude, latitude = MONACO[1]
    estimate = monaco.locate(text.replace("A kiosk is east", "A kiosk is west"))
    assert metres(monaco, estimate.best, (longitude, latitude)) < 30
    assert [e.verdict for e in estimate.evidence if "kiosk" in e.statement] == ["against"]


def test_two_squares_look_alike(harbour, hafenstadt):
    text = "I am standing on a square. There is a fountain north of me and a café to my east."
    estimate = harbour.locate(text)
    sound(estimate, harbour)
    assert estimate.status == Status.AMBIGUOUS
    for row, column in ((5, 38), (31, 59)):
        truth = hafenstadt.lonlat(row + 0.5, column + 0.5)
        assert min(metres(harbour, mode, truth) for mode in estimate.modes[:2]) < 35
    assert estimate.modes[0].probability < 0.7
    assert estimate.next_question(harbour) is not None


def test_a_heading_gives_left_and_right_a_meaning(harbour, hafenstadt):
    text = "I am on Gartenweg, and a bookshop is left of me."
    truth = hafenstadt.lonlat(5.5, 67.5)
    right = harbour.locate(text, heading=0.0)
    wrong = harbour.locate(text, heading=math.pi)
    assert metres(harbour, right.best, truth) < 20
    assert right.status == Status.OK

    def weight(estimate):
        return next(e.weight for e in estimate.evidence if "bookshop" in e.statement.lower())

    assert weight(right) > weight(wrong) + 2
    full_turn = harbour.locate(text, heading=2 * math.pi)
    assert full_turn.best.probability == pytest.approx(right.best.probability, abs=1e-3)


def test_the_way_from_a_known_listener(harbour, hafenstadt):
    """Two fountains on squares: "south of you" decides which."""
    at = hafenstadt.lonlat(20.5, 45.5)  # half way between
    text = "I am next to a fountain on a square, and I am {} of you."
    for wind, (row, column) in (("north", (4, 37)), ("south", (30, 56))):
        estimate = harbour.locate(text.format(wind), listener=at)
        sound(estimate, harbour)
        assert metres(harbour, estimate.best, hafenstadt.lonlat(row + 0.5, column + 0.5)) < 40
    unknown = harbour.locate(text.format("north"))
    assert any("position of the listener" in e.note for e in unknown.evidence)


@pytest.mark.parametrize(
    "text",
    [
        "A lighthouse is north of me and a zoo is to the south.", "asdf qwer zxcv", "north",
        "The sun is shining and I am happy.", "🥐🥐🥐", "((((((", "I am north of you.",
        "I am north of myself.", "მე სკამთან ვარ",
    ],
)  # fmt: skip
def test_lost(text, harbour):
    estimate = harbour.locate(text)
    sound(estimate, harbour)
    assert estimate.status == Status.LOST
    assert estimate.modes == ()
    assert estimate.best is None
    assert estimate.evidence == ()
    assert estimate.next_question(harbour) is None
    assert estimate.reason.endswith(".")
    assert estimate.understood.text == text


def test_what_the_map_does_not_know_is_said(harbour):
    estimate = harbour.locate(
        "A zoo is north of me. I'm on Speicherweg, the museum is south of me."
    )
    assert estimate.status == Status.OK
    silent = [e for e in estimate.evidence if e.verdict == "silent"]
    assert any("zoo" in e.statement and "not on the map" in e.note for e in silent)


def test_nothing_that_fits_together_is_lost(monaco):
    estimate = monaco.locate(
        "The Musée Océanographique is north of the Jardin Exotique. "
        "The Stade Louis-II is east of the Chapelle Sainte-Dévote."
    )
    sound(estimate, monaco)
    assert estimate.status != Status.OK


@pytest.mark.parametrize("text", ["", " ", "\n\t\r ", "\0", "bench\0", "\ud800", "x" * 100_000,
                                  "A bench is north of me. " * 5000, None, 5, 1.5, b"bench",
                                  ["bench"], object])  # fmt: skip
def test_no_description_at_all(text, harbour):
    with pytest.raises(DescriptionError):
        harbour.locate(text)


@given(st.text(max_size=300))
def test_any_text_is_answered_or_refused(harbour, text):
    try:
        estimate = harbour.locate(text)
    except DescriptionError:
        return
    sound(estimate, harbour)


WORDS = [
    "a", "the", "no", "two", "north", "south-west", "of", "me", "you", "it", "I'm", "is", "are",
    "bench", "bakery", "church", "tram stop", "Speicherweg", "Trave", "park", "river", "and",
    "between", "across", "inside", "along", "near", "next to", "30 m", "behind", "left", ".", ",",
    "not", "there", "street", "Brotkorb", "zoo",
]  # fmt: skip


@given(st.lists(st.sampled_from(WORDS), max_size=40), st.none() | st.floats(0, 6))
def test_any_order_of_words_is_answered(harbour, words, heading):
    text = " ".join(words)
    if text.strip():
        estimate = harbour.locate(text, heading=heading)
        sound(estimate, harbour)
        question = estimate.next_question(harbour)
        assert (question is None) or question.options


def test_top(harbour):
    everything = harbour.locate("I am next to a bench.", top=50)
    assert len(everything.modes) > 5
    for top in (1, 2, 5, np.int64(3)):
        estimate = harbour.locate("I am next to a bench.", top=top)
        assert [m.cell for m in estimate.modes] == [m.cell for m in everything.modes[: int(top)]]
    for top in (0, -1, 2.5, None, "3", float("nan")):
        with pytest.raises(OptionError, match="top"):
            harbour.locate(TEXT, top=top)


def test_near_chooses_among_alike(harbour, hafenstadt):
    text = "I am standing on a square. There is a fountain north of me and a café to my east."
    for row, column in ((5, 38), (31, 59)):
        truth = hafenstadt.lonlat(row + 0.5, column + 0.5)
        for near, radius in (((*truth, 60.0), 1000.0), (truth, 60.0), (np.array(truth), 60.0)):
            estimate = harbour.locate(text, near=near, radius=radius)
            sound(estimate, harbour)
            assert estimate.status == Status.OK
            assert metres(harbour, estimate.best, truth) < 35


def test_near_that_covers_the_city_changes_nothing(harbour, hafenstadt):
    plain = harbour.locate(TEXT)
    for radius in (5_000.0, 50_000.0, 1e6, 1e7):
        estimate = harbour.locate(TEXT, near=hafenstadt.center, radius=radius)
        assert estimate.status == plain.status
        assert [m.cell for m in estimate.modes] == [m.cell for m in plain.modes]
        for mode, other in zip(estimate.modes, plain.modes, strict=True):
            assert mode.probability == pytest.approx(other.probability, abs=0.03)


@pytest.mark.parametrize("radius", [1.0, 5.0, 30.0, 100.0])
def test_a_true_near_helps(radius, harbour, hafenstadt):
    text, row, column = HARBOUR[7]
    truth = hafenstadt.lonlat(row + 0.5, column + 0.5)
    estimate = harbour.locate(text, near=truth, radius=radius)
    assert estimate.status == Status.OK
    assert estimate.best.probability > harbour.locate(text).best.probability - 0.01
    assert metres(harbour, estimate.best, truth) < 20


def test_near_somewhere_else_is_lost(harbour):
    for near in ((0.0, 0.0), (-170.0, 80.0), (180.0, -90.0)):
        estimate = harbour.locate(HARBOUR[0][0], near=near)
        sound(estimate, harbour)
        assert estimate.status == Status.LOST
        assert "does not cover" in estimate.reason


BAD_PLACES = [
    (200, 10), (10, 95), (-181, 0), (float("nan"), 1), (float("inf"), 1), (1,), (), [], 5, "abc",
    "9.99,53.55", (None, None), ("a", "b"), (1, 2, 3, 4), {"lon": 9, "lat": 53}, object,
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "place"),
    [*itertools.product(("near", "listener"), BAD_PLACES), ("listener", (9.99, 53.55, 100.0))],
    ids=str,
)
def test_bad_places(name, place, harbour):
    with pytest.raises(OptionError, match=name):
        harbour.locate(TEXT, **{name: place})


@pytest.mark.parametrize(
    "radius", [0, -1, 1e-9, 1e-300, 1e9, 1e300, float("inf"), float("nan"), None, "wide"]
)
def test_bad_radius(radius, harbour, hafenstadt):
    with pytest.raises(OptionError, match="radius"):
        harbour.locate(TEXT, near=hafenstadt.center, radius=radius)
    if radius is not None:
        with pytest.raises(OptionError, match="radius"):
            harbour.locate(TEXT, near=(*hafenstadt.center, radius))


@pytest.mark.parametrize("heading", [float("nan"), float("inf"), "north", (1, 2), object])
def test_bad_heading(heading, harbour):
    with pytest.raises(OptionError, match="heading"):
        harbour.locate(TEXT, heading=heading)


@pytest.mark.parametrize(
    ("options", "hint"),
    [({"matchr": "embedding"}, "did you mean matcher?"), ({"hedding": 0.0}, "did you mean heading?"),
     ({"xyz": 1}, "choose one of answers, by, candidates, ")],
)  # fmt: skip
def test_unknown_options(options, hint, harbour):
    with pytest.raises(OptionError, match=r"is not an option of CityMap\.locate") as caught:
        harbour.locate("I am next to a bakery.", **options)
    assert hint in str(caught.value)


def test_a_description_may_come_ready_made(harbour, hafenstadt):
    museum = Mention(2, "the museum", (Sense("tourism=museum", 1.0),))
    street = Mention(3, "Speicherweg", (), "Speicherweg")
    mentions = (Mention(0, "me"), Mention(1, "you"), museum, street)
    south = Statement(Relation.DIRECTION, 2, 0, bearing=math.pi)
    statements = (south, Statement(Relation.ALONG, 0, 3))
    estimate = harbour.locate(Description("", mentions, statements))
    sound(estimate, harbour)
    assert estimate.status == Status.OK
    assert metres(harbour, estimate.best, hafenstadt.lonlat(35.5, 31.5)) < 20
    assert harbour.locate(Description("")).status == Status.LOST


def test_evidence_names_real_objects(monaco, shared):
    import osmium

    kinds = {"n": "node", "w": "way", "r": "relation"}
    elements = osmium.FileProcessor(str(shared / "data/osm/monaco_2025.osm.pbf"))
    known = {f"{kinds[thing.type_str()]}/{thing.id}" for thing in elements}
    o = monaco.objects
    rows = {o.osm(i): i for i in range(len(o))}
    found = 0
    for text, _, _ in MONACO:
        for mode in monaco.locate(text).modes:
            for thing in (thing for e in mode.evidence for thing in e.objects):
                found += 1
                assert thing.id in known
                row = rows[thing.id]
                assert (thing.label, thing.name) == (o.label(row), o.name(row))
                at = monaco.plane.to_plane((thing.longitude, thing.latitude))
                np.testing.assert_allclose(at, o.center[row], atol=0.01)
    assert found > 10


def test_evidence_says_what_spoke_against(harbour):
    estimate = harbour.locate("I'm on Speicherweg, and the museum is south of me. No bank is here.")
    [museum] = [e for e in estimate.evidence if "museum" in e.statement]
    assert (museum.verdict, museum.objects[0].name) == ("for", "Speichermuseum")
    false = harbour.locate("I'm on Speicherweg near the museum. The museum is north of me.")
    [against] = [e for e in false.evidence if e.statement == "The museum is north of me"]
    assert against.verdict == "against"
    assert "south" in against.note


def test_support_is_the_posterior(harbour):
    estimate = harbour.locate(TEXT)
    assert len(estimate.support) > 10
    assert (np.diff(estimate.support[:, 2]) <= 0).all()
    best = estimate.best
    at = harbour.plane.to_plane(estimate.support[:, :2])
    off = at - harbour.plane.to_plane((best.longitude, best.latitude))
    within = estimate.support[np.hypot(*off.T) <= 50.0, 2].sum()
    assert within == pytest.approx(best.probability, abs=0.05)


def test_the_map_file_is_never_written(harbour_file, tmp_path):
    path = tmp_path / "a.city"
    shutil.copy(harbour_file, path)
    before, content = path.stat(), path.read_bytes()
    path.chmod(0o444)
    tmp_path.chmod(0o555)
    try:
        city = open_map(path)
        estimate = city.locate(TEXT)
        estimate.next_question(city)
        assert estimate.evidence
    finally:
        tmp_path.chmod(0o755)
    after = path.stat()
    assert path.read_bytes() == content
    assert (after.st_mtime_ns, after.st_ino) == (before.st_mtime_ns, before.st_ino)
    assert [p.name for p in tmp_path.iterdir()] == ["a.city"]


def test_an_open_map_does_not_change(harbour_file):
    city = open_map(harbour_file)
    columns = {n: c for n, c in vars(city.objects).items() if isinstance(c, np.ndarray)}
    before = {name: column.copy() for name, column in columns.items()}
    for text, _, _ in HARBOUR:
        city.locate(text)
    for name, column in columns.items():
        np.testing.assert_array_equal(column, before[name], err_msg=name)


def test_threads_that_share_an_opened_map_give_the_same_answers(monaco, monaco_file):
    texts = [text for text, _, _ in MONACO] * 8
    expected = {text: monaco.locate(text) for text in set(texts)}
    opened = open_map(monaco_file)
    with ThreadPoolExecutor(8) as pool:
        for text, estimate in zip(texts, pool.map(opened.locate, texts), strict=True):
            assert estimate.to_dict() == expected[text].to_dict()
            np.testing.assert_array_equal(estimate.support, expected[text].support)


def test_a_map_may_be_rebuilt_while_it_is_open(hafenstadt, tmp_path):
    from placegraph.outdoor.city import build_city

    osm, path = hafenstadt.write_osm(tmp_path / "town.osm"), tmp_path / "a.city"
    build_city(osm, path)
    expected = open_map(path).locate(TEXT).to_dict()
    code = (
        "import sys; from placegraph import build_city\n"
        "for size in (25.0, 50.0): build_city(sys.argv[1], sys.argv[2], cell_size=size)"
    )
    with subprocess.Popen([sys.executable, "-c", code, osm, path]) as builder:  # noqa: S603
        opened, city = 0, open_map(path)
        while builder.poll() is None:
            opened += 1
            time.sleep(0.02)
            again = open_map(path)
            assert again.cells.size in (25.0, 50.0)
            if opened % 5 == 0:
                assert city.locate(TEXT).to_dict() == expected
        assert builder.returncode == 0
    assert opened > 1
    assert open_map(path).locate(TEXT).to_dict() == expected


@pytest.mark.all
def test_another_processor_gives_the_same_bytes(harbour, harbour_file):
    code = (
        "import json, sys; from placegraph import open_map; city = open_map(sys.argv[1])\n"
        "print(json.dumps([city.locate(text).to_dict() for text in sys.argv[2:]]))"
    )
    oldest = {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    texts = [TEXT, *(text for text, _, _ in HARBOUR)]
    told = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code, harbour_file, *texts],
        env=os.environ | oldest, capture_output=True, check=True,
    ).stdout  # fmt: skip
    here = json.dumps([harbour.locate(text).to_dict() for text in texts])
    assert told.decode().strip() == here


def test_other_cells_same_place(make_city, hafenstadt):
    expected = make_city(hafenstadt).locate(TEXT)
    for options in ({"cell_size": 25.0}, {"cell_size": 80.0, "stride": 20.0}):
        found = make_city(hafenstadt, **options).locate(TEXT)
        for mode, other in zip(found.modes, expected.modes, strict=True):
            assert (mode.longitude, mode.latitude) == (other.longitude, other.latitude)
            assert mode.probability == other.probability


def test_swapped_degrees_are_told(harbour, hafenstadt):
    longitude, latitude = hafenstadt.center
    estimate = harbour.locate(TEXT, near=(latitude, longitude))
    assert estimate.status.name == "LOST"
    assert f"longitude comes first, {longitude},{latitude}" in estimate.reason
    with pytest.raises(OptionError, match="longitude comes first"):
        harbour.track(near=(latitude, longitude))
    assert "Swapped" not in harbour.locate(TEXT, near=(0.0, 0.0)).reason
