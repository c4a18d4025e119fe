"""What of a sentence is outside, and what inside."""

import dataclasses
from functools import partial

import pytest

from placegraph.core.estimate import Status
from placegraph.world import World
from placegraph.world.sentence import UPPER_LEVELS, compare_floors, parse_sentence, read_floors

THINGS = ("sofa", "window", "desk", "bookcase", "bed", "sink", "kitchen", "bedroom")


@pytest.fixture
def parse(world):
    return partial(parse_sentence, towns={"west": world.towns["west"]}, objects=THINGS)


@pytest.mark.parametrize(
    ("text", "indoors"),
    [
        ("I am in the library", True),
        ("I am at Lange Straße 7", True),
        ("I am on the second floor", True),
        ("I am next to the sofa", True),
        ("A bakery is north of me. A church is east of the bakery.", False),
    ],
)
def test_who_may_be_indoors(parse, text, indoors):
    assert parse(text).indoors is indoors


@pytest.mark.parametrize(
    ("text", "outside", "inside"),
    [
        ("I am in the library on Lange Straße, by the window", True, ["near: the window"]),
        ("I am next to the sofa", False, ["near: the sofa"]),
        ("A bakery is north of me. A church is east of the bakery.", True, []),
        ("I am in the kitchen of Hotel Hansa", True, ["room: the kitchen of Hotel Hansa"]),
        ("In the bedroom at Lange Straße 7, next to the bed", True, ["room: the bedroom", "holds: the bed"]),
        ("Ich bin in der Bibliothek in der Langen Straße, am Fenster", True, ["near: window"]),
        ("Ich sitze neben dem Sofa. Ein Bett ist links.", False, ["near: sofa", "holds: bed"]),
        ("Im Schlafzimmer steht ein Bett.", False, ["room: bedroom", "holds: bed"]),
        ("Im 1. Stock vom Hotel Hansa, in der Küche", True, ["floor: Im 1. Stock", "room: kitchen"]),
        ("Je suis dans la cuisine, près de la fenêtre.", False, ["room: kitchen", "near: window"]),
        ("Estoy en el hotel, al lado de la cama", True, ["near: bed"]),
        ("Ik ben in de keuken, naast het raam.", False, ["room: kitchen", "near: window"]),
        ("Eine Bäckerei ist nördlich von mir.", True, []),
    ],
)  # fmt: skip
def test_outside_and_inside_in_many_languages(parse, text, outside, inside):
    parsed = parse(text)
    assert bool(parsed.outside) is outside
    assert parsed.to_dict()["inside"] == inside
    assert not [i for i in parsed.ignored if "unknown" in i.reason]


def test_names_and_addresses(parse):
    text = "Ich bin in der Küche der Bücherhalle"
    for names, ignored in (((), True), (("Bücherhalle",), False)):
        assert bool(parse(text, names=names).ignored) == ignored
    parsed = parse("I am at Lange Straße 7")
    assert parsed.outside["west"].mentions[2].name == "7 Lange Straße"


@pytest.mark.parametrize(
    ("text", "levels", "left"),
    [
        ("I am on the second floor of the hotel.", {1, 2}, "I am in the hotel."),
        ("I'm in the hotel, on the 3rd floor, by the window", {2, 3}, "I'm in the hotel, by the window"),
        ("In the kitchen, ground floor", {0}, "In the kitchen"),
        ("We are in the basement.", {-1, -2, -3}, ""),
        ("Ich bin im zweiten Stock der Bibliothek.", {2}, "Ich bin in der Bibliothek."),
        ("Ich bin im Hotel, 2. Stock. Ein Bett ist links.", {2}, "Ich bin im Hotel. Ein Bett ist links."),
        ("Wir sind im Erdgeschoss", {0}, ""),
        ("Im 1. OG vom Hotel", {1}, "im Hotel"),
        ("I am on the top floor of the hotel, by the bed", set(UPPER_LEVELS),
         "I am in the hotel, by the bed"),
        ("Ich bin im Dachgeschoss", set(UPPER_LEVELS), ""),
        ("A bakery is on the ground floor of the hotel.", set(), None),
        ("The floor is dark, and I am next to a bed.", set(), None),
        ("I am in the 3rd street", set(), None),
    ],
)  # fmt: skip
def test_floors_are_understood_and_taken_out(text, levels, left):
    floors, rest = read_floors(text)
    assert {level for floor in floors for level in floor.levels} == levels
    assert rest == (text if left is None else left)


@pytest.mark.parametrize(
    ("text", "level", "storeys", "sign"),
    [
        ("I am on the second floor", "1", 0, 1),
        ("I am on the second floor", "2", 0, 1),
        ("I am on the second floor", "0", 0, -1),
        ("I am on the second floor", "0", 1, 1),  # a house of two storeys
        ("I am on the second floor", "", 0, 0),
        ("I am not on the ground floor", "0", 0, -1),
        ("I am not on the ground floor", "1", 0, 0),
        ("Ich bin im zweiten Stock", "1", 0, -1),
        ("I am in the basement", "-1", 0, 1),
        ("Ich bin im obersten Stock", "0", 0, -1),
        ("I am on the top floor", "3", 0, 0),  # which of those above the ground, nobody knows
    ],
)
def test_what_a_floor_weighs(text, level, storeys, sign):
    weight = compare_floors(read_floors(text)[0], level, storeys)
    assert (weight > 0.5) - (weight < -0.5) == sign


def test_a_floor_tells_twins_of_one_house_apart(world, films):
    up = world.scenes["suite"]
    above = up.anchored(*(dataclasses.replace(a, level="4") for a in up.anchors))
    house = World({"west": world.cities["west"]}, {"low": up, "high": above})
    assert house.locate("I am in the hotel", films["parlour"]).status is Status.AMBIGUOUS
    for text, scene in (("ground floor", "low"), ("fifth floor", "high")):
        told = house.locate(f"I am in the hotel on the {text}", films["parlour"])
        assert (told.status, told.best.scene) == (Status.OK, scene)
    wrong = World(house.cities, {"low": up}).locate(
        "I am in the hotel on the fifth floor", films["parlour"]
    )
    assert wrong.status is Status.AMBIGUOUS
    assert "floor 0 is not the stated one" in wrong.reason
