import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from placegraph.outdoor.track.motion import (
    _TENS,
    _UNITS,
    DEFAULT_DISTANCE,
    Leg,
    parse_duration,
    split_legs,
    write_digits,
)

NORTH, EAST, SOUTH, WEST = 0.0, 0.5, 1.0, 1.5  # bearings and turns in units of pi
LEFT, RIGHT, AHEAD, BACK = -0.5, 0.5, 0.0, 1.0

# text, and its parts: (metres, bearing, turn) of a leg, or a text
SAID = [
    ("I walked 200 m east.", [(200, EAST, None)]),
    ("I have just walked two hundred and fifty metres north", [(250, NORTH, None)]),
    ("We went about 80 metres north-east.", [(80, 0.25, None)]),
    ("Walked three blocks NW.", [(300, 1.75, None)]),
    ("I headed due west for a quarter of an hour.", [(1200, WEST, None)]),
    ("went straight on for two minutes", [(160, None, AHEAD)]),
    ("I carried on for half an hour", [(2400, None, AHEAD)]),
    ("then I turned left", [(0, None, LEFT)]),
    ("Turn right", [(0, None, RIGHT)]),
    ("I turned slightly left.", [(0, None, -0.25)]),
    ("I turned 90 degrees right.", [(0, None, RIGHT)]),
    ("I walked 100 m towards 45 degrees", [(100, 0.25, None)]),
    ("I turned around and went back 30 m.", [(0, None, BACK), (30, None, AHEAD)]),
    ("I went back.", [(DEFAULT_DISTANCE, None, BACK)]),
    ("I turned right and went 50 m.", [(0, None, RIGHT), (50, None, AHEAD)]),
    ("I walked 120 m.", [(120, None, None)]),
    ("200 m east", [(200, EAST, None)]),
    ("I walked 200 m east, then 100 m north", [(200, EAST, None), (100, NORTH, None)]),
    ("I crossed the street.", [(15, None, None)]),
    ("I walked ten steps north.", [(7.5, NORTH, None)]),
    ("I ran for 10 minutes.", [(1500, None, None)]),
    ("I am walking 50 m south.", [(50, SOUTH, None)]),
    ("I stayed there.", [(0, None, AHEAD)]),
    ("I walked about 100 metres along the road", [(100, None, None), "I am on the road."]),
    ("I walked 90 m down Lange Straße to the tram stop",
     [(90, None, None), "I am on Lange Straße. I am at the tram stop."]),
    ("I turned left onto Main Street.", [(0, None, LEFT), "I am on Main Street."]),
    ("I went straight on until I reached the church.",
     [(DEFAULT_DISTANCE, None, AHEAD), "I am at the church."]),
    ("I walked along the canal until the bridge.",
     [(DEFAULT_DISTANCE, None, None), "I am on the canal. I am at the bridge."]),
    ("I reached the church.", [(DEFAULT_DISTANCE, None, None), "I am at the church."]),
    ("I walked 50 m towards the church", [(50, None, None)]),
    ("I walked 200 m east and there is a bakery to my north.",
     [(200, EAST, None), "there is a bakery to my north."]),
    ("After 100 m I see a bakery to my left.", [(100, None, AHEAD), "I see a bakery to my left."]),
    ("After walking for five minutes to the south-west, I am on a bridge.",
     [(400, 1.25, None), "I am on a bridge."]),
    ("A bench is here. I went 20 m north. A bakery is north of me, and a kiosk is south.",
     ["A bench is here.", (20, NORTH, None), "A bakery is north of me, and a kiosk is south."]),
]  # fmt: skip

STILL = [
    "A bakery is north of me, and there is a bench 20 m south of me.",
    "I am walking north.",
    "The road runs north.",
    "I'm north of the church, on the left.",
    "I went north of the church.",
    "I am 100 m east of you.",
    "The bank has moved.",
    "I am next to a walking path and a turning circle.",
    "🥐 12 °",
]


@pytest.mark.parametrize(("text", "expected"), SAID)
def test_ways(text, expected):
    parts = split_legs(text)
    assert len(parts) == len(expected), parts
    for part, wanted in zip(parts, expected, strict=True):
        if isinstance(wanted, str):
            assert part == wanted
            continue
        assert isinstance(part, Leg)
        metres, bearing, turn = wanted
        assert part.distance == pytest.approx(metres)
        for angle, told in ((part.bearing, bearing), (part.turn, turn)):
            assert angle == (None if told is None else pytest.approx(told * math.pi))


@pytest.mark.parametrize("text", STILL)
def test_what_is_no_way_comes_back_as_it_is(text):
    assert split_legs(text) == [text]


def test_how_loosely():
    plain, exact, blocks, timed = (
        split_legs(f"I walked {how} east.")[0]
        for how in ("100 m", "exactly 100 m", "a block", "75 seconds")
    )
    assert exact.spread < plain.spread < timed.spread < blocks.spread
    assert plain.spread == pytest.approx(27.0)
    due, loose, north = (
        split_legs(f"I went 10 m {how}.")[0].sigma
        for how in ("due north", "roughly north", "north")
    )
    assert due < north < loose


@pytest.mark.parametrize(
    ("text", "number"),
    [("two hundred and fifty", "250"), ("a thousand", "1000"), ("twenty-one", "21"),
     ("three thousand four hundred", "3400"), ("nineteen", "19"), ("the bone", "the bone")],
)  # fmt: skip
def test_numbers(text, number):
    assert write_digits(text) == number


@given(st.integers(0, 9_999))
def test_numbers_in_words_are_read(n):
    ones, tens = list(_UNITS), list(_TENS)
    words = []
    if n >= 1000:
        words += [ones[n // 1000], "thousand"]
    if n % 1000 >= 100:
        words += [ones[n % 1000 // 100], "hundred"]
    if n % 100 >= 20:
        words.append(tens[n % 100 // 10 - 2])
        words += [ones[n % 10]] if n % 10 else []
    elif n % 100 or not words:
        words.append(ones[n % 100])
    assert write_digits(" ".join(words)) == str(n)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("2 minutes", 120), ("a minute", 60), ("half an hour", 1800), ("a quarter of an hour", 900),
     ("an hour and a half", 5400), ("5-10 minutes", 450), ("a couple of minutes", 120),
     ("30 secs", 30), ("1.5 h", 5400), ("2 and a half minutes", 150)],
)  # fmt: skip
def test_times(text, expected):
    assert parse_duration(text) == expected


WORDS = ["I", "walked", "went", "turned", "left", "north", "200", "m", "two", "hundred", "minutes",
         "for", "to", "the", "church", "and", "then", ",", ".", "along", "until", "reached", "after",
         "half", "a", "is", "of", "me", "°", "back", "steps", "hour"]  # fmt: skip


@given(st.text(max_size=200) | st.lists(st.sampled_from(WORDS), max_size=25).map(" ".join))
@example("I walked  and.")
@example("after 5 m")
@example("hundred m north")
def test_any_text_is_cut(text):
    for part in split_legs(text):
        if isinstance(part, Leg):
            assert part.distance >= 0.0
            assert part.spread >= 0.0
            assert part.bearing is None or part.turn is None
            assert math.isfinite(part.sigma)
        else:
            assert isinstance(part, str)
