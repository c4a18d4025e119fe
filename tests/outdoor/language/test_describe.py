from __future__ import annotations

from math import cos, pi, radians, sin

import pytest
from rapidfuzz import fuzz

from placegraph.errors import DescriptionError
from placegraph.language.text import metres
from placegraph.outdoor.language import describe, normalise, tokens
from placegraph.outdoor.language.description import SPEAKER
from placegraph.outdoor.language.languages import english
from placegraph.outdoor.language.scan import scan_english
from placegraph.outdoor.language.statements import RANKED


@pytest.mark.parametrize(
    ("text", "mend"),
    [
        ("", "say what is around you"), (" \n\t ", "say what is around you"),
        ("north " * 20_000, "are allowed; shorten it"),
        ("a bakery\x00 north of me", "remove it"), ("a bakery \x1b[1m north of me", "remove it"),
        (b"a bakery north of me", "pass a str"), (None, "pass a str"),
    ],
)  # fmt: skip
def test_refused_with_a_mend(text, mend):
    with pytest.raises(DescriptionError, match=mend):
        describe(text)


@pytest.mark.parametrize("text", ["asdf qwer", "¿Qué?", "12345", "!!! ???", "the the the", "🏠"])
def test_nothing_understood_is_no_guess(text):
    description = describe(text)
    assert description.statements == ()
    assert description.ignored


LONG = "9" * 5000
"""Digits of a number that Python reads no more."""


@pytest.mark.parametrize(
    "said", [f"{LONG} benches are", f"The {LONG}th Street is", f"Es gibt {LONG} Bänke"]
)
def test_numbers_may_be_longer_than_python_reads(said):
    describe(f"{said} north of me.")


class Names:
    """The names of a small map."""

    def __init__(self, *names):
        self.names = {tuple(tokens(name)) for name in names}

    def longest_name(self, words, start):
        lengths = [len(n) for n in self.names if tuple(words[start : start + len(n)]) == n]
        return max(lengths, default=0)

    def find_sites(self, _text):
        return []

    def closest_name(self, phrase):
        words = " ".join(tokens(phrase))
        found = [(" ".join(n), fuzz.ratio(words, " ".join(n)) / 100) for n in self.names]
        return max(found, key=lambda pair: pair[1], default=None)


def test_names_of_the_map_are_found_in_small_letters():
    names = "Rex Theater|Ben & Jerry's|Love, Pittsburgh|E Carson Street|Park|Eat'n Park"
    written = ["rex theatre", "ben and jerrys", "east carson st", "love pittsburgh", "eat'n park"]
    text = "the {} is north of {} on {}. i'm at {}, near {}".format(*written)
    found = describe(text, names=Names(*names.split("|"))).mentions[2:]
    assert [m.name for m in found] == written


def test_common_nouns_stay_nouns_though_the_map_has_such_names():
    names = Names("Park", "The Bench", "Bus Stop", "North")
    things = describe("The park is north of the bench and a bus stop.", names=names).mentions[2:]
    assert [m.name for m in things] == ["", "", ""]


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("Ripleys Acquarium of Canada", "ripleys aquarium of canada"),
        ("Smalman Street", "smallman st"), ("Quite Another Cafe", "Quite Another Cafe"),
        ("4th Street", "4th Street"), ("East Canal Street", "East Canal Street"),
    ],
)  # fmt: skip
def test_misspelt_names_are_mended_where_the_map_tells(written, name):
    names = Names(
        "Ripley's Aquarium of Canada", "Smallman Street", "14th Street", "West Canal Street"
    )
    description = describe(f"I'm near the {written}.", names=names)
    assert description.mentions[2].name == name
    assert written in description.mentions[2].words


@pytest.mark.parametrize(
    ("text", "related"),
    [
        ("Elm Park: north of the gate.", [("Elm Park", "I"), ("I", "the gate")]),
        ("Chinatown: by the gate.", [("Chinatown", "I"), ("I", "the gate")]),
        ("Location: by the gate.", [("I", "the gate")]),
        ("Entrance: north of Elm Park.", [("Entrance", "Elm Park")]),
        ("North of me: a gate.", [("a gate", "I")]),
        ("Open from 10:30. By the gate.", [("I", "the gate")]),
    ],
)
def test_a_colon_behind_a_name_is_a_stop(text, related):
    found = describe(text, names=Names("Elm Park", "Chinatown"))
    words = [mention.words for mention in found.mentions]
    assert [(words[s.source], words[s.target]) for s in found.statements] == related


def test_a_rank_among_several_is_reported():
    found = describe("I'm at the third house on Oak Street. A bench is north of me.")
    assert [(i.text, i.reason) for i in found.ignored] == [("the third house", RANKED)]
    assert len(found.statements) == 3


def test_the_longest_name_wins():
    names = Names("Penn", "Penn Avenue", "Penn Avenue Fish Company")
    description = describe("I'm at Penn Avenue Fish Company on Penn Avenue.", names=names)
    assert [m.name for m in description.mentions[2:]] == ["Penn Avenue Fish Company", "Penn Avenue"]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("Ripley's_Aquarium_of_Canada", "ripleys aquarium of canada"),
        ("E Carson St.", "East Carson Street"), ("St. Mary's", "Saint Marys"),
        ("Café Zoë", "cafe zoe"), ("Ben & Jerry's", "Ben and Jerry’s"), ("Fifth Avenue", "5th Ave"),
        ("Rex Theatre", "rex theater"),
    ],
)  # fmt: skip
def test_names_meet_in_their_normal_form(one, other):
    assert normalise(one) == normalise(other)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("30 m", 30), ("about 30 meters", 30), ("2.5 km", 2500), ("100 ft", 30.48),
        ("50 yards", 45.72), ("half a mile", 804.672), ("a quarter of a mile", 402.336),
        ("two blocks", 200), ("one and a half blocks", 150), ("1 and half block", 150),
        ("2&half blocks", 250), ("2 1/2 blocks", 250), ("2½ blocks", 250), ("3-4 blocks", 350),
        ("2½blocks", 250),
        ("one or two blocks", 150), ("a few blocks", 300), ("a couple of blocks", 200),
        ("half of a block", 50), ("a 2 minute walk", 160), ("two hundred metres", 200),
        ("a hundred metres", 100), ("15 minutes' walk", 1200), ("20 paces", 15),
    ],
)  # fmt: skip
def test_distances(text, expected):
    words = [word for sentence in scan_english(f"{text} north", english()) for word in sentence]
    assert [word.metres for word in words if word.kind == "measure"] == [pytest.approx(expected)]


def test_a_block_alone_is_no_distance():
    assert metres("a block", "a") == pytest.approx(100)
    words = [w.kind for w in scan_english("on a block with trees", english())[0]]
    assert "measure" not in words


@pytest.mark.parametrize(
    ("text", "sentences"),
    [
        ("I'm on E. Carson St. near St. Clair Ave. It is wide.", 2),
        ("North of me: a church; south of me: a school.", 2), ("It's 2.5 km away. OK?", 2),
        ("one\n\ntwo", 2),
    ],
)  # fmt: skip
def test_sentences(text, sentences):
    assert len(scan_english(text, english())) == sentences


def test_a_heading_turns_with_the_speaker():
    for degrees in (0, 45, 200, -90, 720):
        (statement,) = describe("A church is to my left.", heading=radians(degrees)).statements
        assert statement.bearing == pytest.approx((radians(degrees) - pi / 2) % (2 * pi))


def lengths(bearing):
    """Blocks of a town where streets run 80 m apart and avenues 250 m."""
    along = bearing is not None and abs(cos(bearing)) > 0.7
    return 80.0 if along else 250.0


@pytest.mark.parametrize(
    ("text", "target", "east", "north"),
    [
        ("From where you are it's 9 blocks west, then 4 blocks north.", "you", -2250, 320),
        ("Go two blocks west, then turn left and walk three blocks.", "you", -500, -240),
        (
            "It's 16 blocks south and a block and a half west from where you are.",
            "you",
            -375,
            -1280,
        ),
        ("From the station walk north for 300 metres, then 100 m east.", "the station", 100, 300),
        ("Walk until you reach the church, then go 2 blocks east.", "the church", 500, 0),
        ("It is 9 blocks west of you, then 4 north.", "you", -2250, 320),
        ("Go south 8 blocks and then east 2.", "you", 500, -640),
        ("Starting at the church, go 2 blocks east.", "the church", 500, 0),
        ("I'm two blocks south of the church.", "the church", 0, -160),
    ],
)
def test_legs_make_one_way_in_blocks_of_the_map(text, target, east, north):
    description = describe(text, block_length=lengths)
    ways = [s for s in description.statements if s.distance is not None]
    assert [description.mentions[s.target].words for s in ways] == [target]
    (way,) = ways
    assert way.source == SPEAKER
    assert way.distance * sin(way.bearing) == pytest.approx(east, abs=1.0)
    assert way.distance * cos(way.bearing) == pytest.approx(north, abs=1.0)


CONTRADICTIONS = (
    "The church is north of the school. The church is south of the school.",
    "The church is north of me. I'm north of the church.",
    "A bakery is to my east. It is west of me.", "There are no trees here. There is a tree.",
    "There is no church to my north. A church is north of me.",
    "I'm at the bank. The church is north of me. The church is south of the bank.",
)  # fmt: skip
CONSISTENT = (
    "The church is north of the school. The church is east of the school.",
    "A church is north of me. A church is south of me.",
    "There are no trees to my north. There is a tree to my south.",
    "The bench is on the north of the bench.",
    "The building is on the east of the road. The building is on the west of the road.",
    "A bench is north of the bank. A bench is south of the bank.", "Head north, then south.",
    "There is no bank. There is a church.",
)  # fmt: skip


@pytest.mark.parametrize("text", CONTRADICTIONS + CONSISTENT)
def test_contradictions_are_told(text):
    assert bool(describe(text).conflicts) == (text in CONTRADICTIONS)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("I am near the Salvation Army and the bench.", ["Salvation Army", "bench"]),
        ("I'm at the Independent Hotel.", ["Independent Hotel"]),
        ("There is an Aldi next to the Cathedral.", ["Aldi", "Cathedral"]),
        ("The craft shop is next to the beam.", ["craft shop", "beam"]),
        ("Turn onto W. 38th. Walk past the bank.", ["W. 38th", "bank"]),
        ("It's on the south side of East 34th in the middle of the block.", ["East 34th"]),
        ("Go north on 6th Ave. After passing the bank turn left.", ["6th Ave", "bank"]),
        ("Wanna join me? I'm at the bank.", ["bank"]), ("Zappos is near me.", ["Zappos"]),
        ("I'm at the corner of 5th and West 34th.", ["5th", "West 34th"]),
        ("I'm at 125 Main Street, on the 5th floor.", ["125 Main Street"]),
        ("There are 12 benches on Elm Street.", ["benches", "Elm Street"]),
    ],
)  # fmt: skip
def test_names_and_common_nouns(text, found):
    names = Names("Salvation Army", "The Independent", "Aldi", "Craft", "Cathedral Square")
    mentions = describe(text, names=names).mentions[2:]
    assert [m.name or m.words.partition(" ")[2] for m in mentions] == found


def test_unknown_words_are_told_with_what_they_look_like():
    said = describe("A zorblat is north of me. I see a kiosq and the stop_position.")
    told = {i.text: i.reason for i in said.ignored}
    assert told["A zorblat"] == "unknown word"
    assert told["the stop_position"] == "is known, but never on a city map"
    assert told["a kiosq"].startswith("unknown word; did you mean kiosk")
    assert said.unknown_words == ("A zorblat", "a kiosq", "the stop_position")
