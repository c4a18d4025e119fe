from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import DescriptionError
from placegraph.indoor.language import Kind, read
from placegraph.language.text import LONGEST_TEXT

SAID = {
    "There's a huge white corner sofa with a floor lamp beside, and two orange plastic chairs in the"
    " corner":
        "related(floor lamp, huge white corner sofa) with | related(floor lamp, huge white corner sofa)"
        " next to | holds(2 orange plastic in the corner chairs)",
    "The walls are blue and the wardrobe is made of dark wood.":
        "holds(blue walls) | holds(dark wood wardrobe)",
    "sideboard pale green, a chair in red against the wall":
        "holds(pale green sideboard) | holds(red against the wall chair)",
    "two chairs, a red one and a blue one": "holds(2 chairs) | holds(red chairs) | holds(1 blue chairs)",
    "The sofa, which is red, stands in the middle.": "holds(in the middle red sofa)",
    "no tub or shower, neither a bin nor a stool":
        "not holds(tub) | not holds(shower) | not holds(bin) | not holds(stool)",
    "In the middle of the room stands a table, on the wall hangs a mirror":
        "holds(in the middle table) | holds(against the wall mirror)",
    "a door to the balcony, desk, light and a chair beside":
        "holds(door) | holds(desk) | related(chair, light) next to",
    "three armchairs side by side and a white heater on the opposite wall":
        "holds(3 in a row armchairs) | holds(white against the wall heater)",
    "It's an entrance hall, quite empty.": "room(empty entrance hall)",
    "A big room with a desk in the middle": "room(big room) | holds(in the middle desk)",
    "You're in a small bathroom. Through the door I can see the bed of the bedroom.":
        "room(small bathroom) | room(bedroom) ~0.3 | towards(bed) 0° wide",
    "It looks like an office space with four desks arranged in two rows":
        "room(office space) | holds(4 in a row desks)",
    "next to the sofa, facing the window": "near(sofa) | towards(window) 0°",
    "I am in the kitchen between the table and the fridge, looking at the door; the window is on my left":
        "room(kitchen) | between(table, fridge) | towards(door) 0° | towards(window) 90°",
    "standing in front of the tv, behind me is a bookcase": "near(tv) in front of | towards(bookcase) 180°",
    "a kitchen with two sinks": "room(kitchen) | holds(2 sinks)",
    "a bedroom without a desk, with a plant on the table":
        "room(bedroom) | not holds(desk) | related(plant, table) on",
    "three chairs around a table": "holds(3 chairs) | related(3 chairs, table) next to",
    "There is a plant on the table next to the window.":
        "related(plant, table) on | related(table, window) next to",
    "I see a plant on my left and a chest of drawers behind me":
        "towards(plant) 90° | towards(chest of drawers) 180°",
    "a kitchen with two sinks and a fridge, no oven":
        "room(kitchen) | holds(2 sinks) | holds(fridge) | not holds(oven)",
    "The kitchen has two sinks and no window": "room(kitchen) | holds(2 sinks) | not holds(window)",
    "with my back to the wall, a standing lamp is 2 m ahead of me":
        "towards(wall) 180° | towards(standing lamp) 0° 2m",
    "on my left, there is a plant": "towards(plant) 90°",
    "The sofa and the table are on my left": "towards(sofa) 90° | towards(table) 90°",
    "I'm sitting on the brown leather sofa, the tv stand is in front of me":
        "near(brown leather sofa) on | towards(tv stand) 0°",
    "I cannot see the door": "not towards(door) 0° wide",
    "not near the sofa": "far(sofa)",
    "I am not in the kitchen": "not room(kitchen)",
    "the table has a plant on it": "related(plant, table) with",
    "a bathroom with a toilet and a bathtub but no window":
        "room(bathroom) | holds(toilet) | holds(bathtub) | not holds(window)",
    "a living room with a red sofa, a picture above the sofa and a coffee table in front of it":
        "room(living room) | related(picture, red sofa) above | related(coffee table, red sofa) in front"
        " of",
    "in the corner of the bedroom": "room(bedroom)",
    "far from the door, 2 m from the bed, 50 cm from the wall":
        "far(door) | near(bed) 2m | near(wall) 0.5m",
    "a home with two bathrooms": "room(2 bathrooms)",
    "Standing next to the table near the window, I face the door.":
        "near(table) | related(table, window) next to | towards(door) 0°",
    "behind me on my left is a wardrobe": "towards(wardrobe) 135°",
    "maybe near the tv": "near(tv) ~0.6",
    "between two chairs": "between(2 chairs, 2 chairs)",
    "I am in the living room. The sofa is behind me. There is a lamp next to it.":
        "room(living room) | towards(sofa) 180° | related(lamp, sofa) next to",
    "KitchenTable next to RoomWindow": "related(kitchen table, room window) next to",
    "A small bedroom: bed, nightstand, no tv":
        "room(small bedroom) | holds(bed) | holds(nightstand) | not holds(tv)",
    "The window is left of the bookcase": "related(window, bookcase) left of",
    "I have the window on my left and the door behind me": "towards(window) 90° | towards(door) 180°",
    "looking out of the window, my back to the bed": "towards(window) 0° | towards(bed) 180°",
    "to the left of the sofa there's a lamp": "related(lamp, sofa) left of",
    "Facing a built-in wardrobe, the night stand is on my right side":
        "towards(built in wardrobe) 0° | towards(night stand) -90°",
    "a study with several monitors on the desk":
        "room(study) | holds(some monitors) | related(some monitors, desk) on",
    "the door of the kitchen is to my right": "room(kitchen) | towards(door) -90°",
    "next to me is a plant": "near(plant)",
}  # fmt: skip


@pytest.mark.parametrize("text", SAID)
def test_what_is_said(text, list_statements):
    assert " | ".join(list_statements(read(text))) == SAID[text]


def test_what_is_not_understood_is_told():
    sentence = read("next to the sofa. In the corner!")
    assert [s.kind for s in sentence.statements] == [Kind.NEAR]
    assert [i.text for i in sentence.ignored] == ["In the corner"]
    nothing = read("Well, so what?")
    assert not nothing.statements
    assert nothing.ignored


def test_statements_keep_their_words():
    text = "I am next to the sofa, and behind me is a tall plant."
    assert [s.text for s in read(text).statements] == ["next to the sofa", "behind me"]


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "empty"), (" \n", "empty"), ("x" * (LONGEST_TEXT + 1), "characters"), ("a\x00b", "contains"),
     (7, "of type int")],
)  # fmt: skip
def test_what_is_no_text(text, message):
    with pytest.raises(DescriptionError, match=message):
        read(text)


THINGS = ["sofa", "coffee table", "tv stand", "chest of drawers", "standing lamp", "bed", "side table",
          "zorp", "TV", "kitchen cabinet", "night stand", "sink"]  # fmt: skip
ROOMS = ["kitchen", "living room", "bathroom", "hall"]
NUMBERS = ["a", "two", "three", "12"]
COUNTS = [None, 2, 3, 12]
RELATIONS = {"on": "on", "next to": "next to", "under": "under", "to the left of": "left of",
             "on top of": "on", "beside": "next to", "behind": "behind", "in": "in"}  # fmt: skip
DIRECTIONS = {"on my left": 90, "to my right": -90, "behind me": 180, "in front of me": 0}


@given(
    st.sampled_from(ROOMS),
    st.lists(st.tuples(st.sampled_from(THINGS), st.integers(0, 3), st.booleans()), min_size=1,
             max_size=5, unique_by=lambda t: t[0]),
    st.sampled_from(["A {room} with {things}.", "The {room} has {things}.",
                     "I am in the {room} with {things}", "{things} in a {room}"]),
)  # fmt: skip
def test_what_a_room_holds_comes_back(room, things, form):
    named = [
        f"no {thing}" if no else f"{NUMBERS[n]} {thing}{'s' if n else ''}"
        for thing, n, no in things
    ]
    sentence = read(form.format(room=room, things=" and ".join(named)))
    held = [s for s in sentence.statements if s.kind is Kind.HOLDS]
    found = [(sentence.mentions[s.mentions[0]].label, sentence.mentions[s.mentions[0]].count, s.negated)
             for s in held]  # fmt: skip
    wanted = [
        (f"{thing}s".lower() if n and not no else thing.lower(), None if no else COUNTS[n], no)
        for thing, n, no in things
    ]
    assert found == wanted
    (where,) = [s for s in sentence.statements if s.kind is Kind.ROOM]
    assert sentence.mentions[where.mentions[0]].room == room
    assert not sentence.ignored


@given(
    st.sampled_from(THINGS),
    st.sampled_from(sorted(RELATIONS)),
    st.sampled_from(THINGS),
    st.sampled_from(["A {a} {r} the {b}.", "There is a {a} {r} a {b}", "the {a} is {r} the {b}",
                     "{r} the {b} is a {a}", "I see a {a} {r} the {b}"]),
)  # fmt: skip
def test_how_things_lie_comes_back(one, relation, other, form):
    if one == other:
        return
    sentence = read(form.format(a=one, r=relation, b=other))
    (s,) = [s for s in sentence.statements if not s.wide]
    assert s.kind is Kind.RELATED
    assert s.relation == RELATIONS[relation]
    assert [sentence.mentions[t].label for t in s.mentions] == [one.lower(), other.lower()]


@given(
    st.lists(st.tuples(st.sampled_from(THINGS), st.sampled_from(sorted(DIRECTIONS)),
                       st.sampled_from(["the {t} is {d}", "{d} is a {t}", "there is a {t} {d}",
                                        "I see a {t} {d}", "a {t} {d}", "with the {t} {d}"])),
             min_size=1, max_size=4, unique_by=lambda t: t[0]),
    st.sampled_from([", ", "; ", ". ", " and "]),
)  # fmt: skip
def test_where_things_are_seen_comes_back(seen, joint):
    sentence = read(joint.join(form.format(t=thing, d=way) for thing, way, form in seen))
    found = {
        (sentence.mentions[s.mentions[0]].label, round(s.bearing * 180 / pi))
        for s in sentence.statements
        if s.kind is Kind.TOWARDS
    }
    assert found == {(thing.lower(), DIRECTIONS[way]) for thing, way, _ in seen}


TALK = """
the a no two several sofa table kitchen next to on my left behind me facing between and , . ; :
with without is are there I am see has of corner 2 m away from far not cannot it window looking at
standing room in front but while maybe - ' "quoted" ? ( ) zorp under above which that my back
"""
WORDS = TALK.split()


@given(st.lists(st.sampled_from(WORDS), max_size=30).map(" ".join) | st.text(max_size=200))
def test_no_text_breaks_it(text):
    try:
        sentence = read(text)
    except DescriptionError:
        return
    for s in sentence.statements:
        assert all(0 <= t < len(sentence.mentions) for t in s.mentions)
        assert len(s.mentions) == (2 if s.kind in (Kind.RELATED, Kind.BETWEEN) else 1)
        assert s.text in text
    assert sentence.statements or sentence.ignored
    assert sentence.to_dict()["text"] == text


def test_numbers_may_be_longer_than_python_reads():
    read(f"a room with {'9' * 5000} chairs")
