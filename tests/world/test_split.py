"""What of a sentence is outside, and what inside."""

import pytest

from placegraph.world.sentence import parse_sentence

THINGS = ("sofa", "window", "desk", "bookcase", "bed", "sink", "kitchen", "bedroom")


@pytest.mark.parametrize(
    ("text", "outside", "inside"),
    [
        ("I am in the library on Lange Straße, by the window", True, ["near: the window"]),
        ("I am next to the sofa", False, ["near: the sofa"]),
        ("A bakery is north of me. A church is east of the bakery.", True, []),
        ("I am in the kitchen of Hotel Hansa", True, ["room: the kitchen of Hotel Hansa"]),
        ("In the bedroom at Lange Straße 7, next to the bed", True, ["room: the bedroom", "holds: the bed"]),
    ],
)  # fmt: skip
def test_split(world, text, outside, inside):
    told = parse_sentence(text, {"west": world.towns["west"]}, THINGS)
    assert bool(told.outside) is outside
    assert told.to_dict()["inside"] == inside


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
def test_who_may_be_indoors(world, text, indoors):
    assert parse_sentence(text, {"west": world.towns["west"]}, THINGS).indoors is indoors


@pytest.mark.parametrize(
    ("text", "outside", "inside"),
    [
        ("Ich bin in der Bibliothek in der Langen Straße, am Fenster", True, ["near: window"]),
        ("Ich sitze neben dem Sofa. Ein Bett ist links.", False, ["near: sofa", "holds: bed"]),
        ("Im Schlafzimmer steht ein Bett.", False, ["room: bedroom", "holds: bed"]),
        ("Im 1. Stock vom Hotel Hansa, in der Küche", True, ["floor: Im 1. Stock", "room: kitchen"]),
        ("Je suis dans la cuisine, près de la fenêtre.", False, ["room: kitchen", "near: window"]),
        ("Estoy en el hotel, al lado de la cama", True, ["near: bed"]),
        ("Ik ben in de keuken, naast het raam.", False, ["room: kitchen", "near: window"]),
        ("Eine Bäckerei ist nördlich von mir.", True, []),
        ("Ich bin neben dem Bett. I am in the bedroom.", False, ["near: bed", "room: bedroom"]),
    ],
)  # fmt: skip
def test_rooms_are_understood_in_other_languages(world, text, outside, inside):
    told = parse_sentence(text, {"west": world.towns["west"]}, THINGS)
    assert bool(told.outside) is outside
    assert told.to_dict()["inside"] == inside
    assert not [i for i in told.ignored if "unknown" in i.reason]


def test_a_name_that_is_heard_is_not_called_ignored(world):
    text = "Ich bin in der Küche der Bücherhalle"
    for names, ignored in (((), True), (("Bücherhalle",), False)):
        told = parse_sentence(text, {"west": world.towns["west"]}, THINGS, names=names)
        assert bool(told.ignored) == ignored


def test_addresses_are_known_number_last(world):
    told = parse_sentence("I am at Lange Straße 7", {"west": world.towns["west"]}, THINGS)
    assert told.outside["west"].mentions[2].name == "7 Lange Straße"
