import importlib.resources
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.indoor.encode.networks import PASCAL
from placegraph.indoor.encode.words import (
    DIMENSION,
    GROUP,
    KIN,
    embed_label,
    hash_tree,
    is_known_label,
    join_words,
    load_tree,
    make_codes,
    parse_tree,
)

# names of what indoor data sets label, to see that the tree of things knows them
NYU40 = """
wall|floor|cabinet|bed|chair|sofa|table|door|window|bookshelf|picture|counter|blinds|desk|shelves
curtain|dresser|pillow|mirror|floor mat|clothes|ceiling|books|refridgerator|television|paper|towel
shower curtain|box|whiteboard|person|night stand|toilet|sink|lamp|bathtub|bag
"""
COCO = """
person|bicycle|car|motorcycle|airplane|bus|train|truck|boat|traffic light|bench|bird|cat|dog
backpack|umbrella|handbag|tie|suitcase|frisbee|skis|snowboard|sports ball|kite|baseball bat
skateboard|surfboard|tennis racket|bottle|wine glass|cup|fork|knife|spoon|bowl|banana|apple|sandwich
orange|broccoli|carrot|hot dog|pizza|donut|cake|chair|couch|potted plant|bed|dining table|toilet|tv
laptop|mouse|remote|keyboard|cell phone|microwave|oven|toaster|sink|refrigerator|book|clock|vase
scissors|teddy bear|hair drier|toothbrush
"""

SCANNET200 = """
wall|chair|floor|table|door|couch|cabinet|shelf|desk|office chair|bed|pillow|sink|picture|window
toilet|bookshelf|monitor|curtain|book|armchair|coffee table|box|refrigerator|lamp|kitchen cabinet
towel|clothes|tv|nightstand|counter|dresser|stool|cushion|plant|ceiling|bathtub|end table
dining table|keyboard|bag|backpack|toilet paper|printer|tv stand|whiteboard|blanket|shower curtain
trash can|closet|stairs|microwave|stove|shoe|computer tower|bottle|bin|ottoman|bench|board
washing machine|mirror|copier|basket|sofa chair|file cabinet|fan|laptop|shower|paper|person
paper towel dispenser|oven|blinds|rack|plate|blackboard|piano|suitcase|rail|radiator
recycling bin|container|wardrobe|soap dispenser|telephone|bucket|clock|stand|light
laundry basket|pipe|clothes dryer|guitar|toilet paper holder|seat|speaker|column|bicycle|ladder
bathroom stall|shower wall|cup|jacket|storage bin|coffee maker|dishwasher|paper towel roll|machine
mat|windowsill|bar|toaster|bulletin board|ironing board|fireplace|soap dish|kitchen counter
doorframe|toilet paper dispenser|mini fridge|fire extinguisher|ball|hat|shower curtain rod
water cooler|paper cutter|tray|shower door|pillar|ledge|toaster oven|mouse
toilet seat cover dispenser|furniture|cart|storage container|scale|tissue box|light switch|crate
power outlet|decoration|sign|projector|closet door|vacuum cleaner|candle|plunger|stuffed animal
headphones|dish rack|broom|guitar case|range hood|dustpan|hair dryer|water bottle|handicap bar
purse|vent|shower floor|water pitcher|mailbox|bowl|paper bag|alarm clock|music stand
projector screen|divider|laundry detergent|bathroom counter|bathroom vanity|closet wall
laundry hamper|bathroom stall door|ceiling light|trash bin|dumbbell|stair rail|tube
bathroom cabinet|cd case|closet rod|coffee kettle|structure|shower head|keyboard piano
case of water bottles|coat rack|storage organizer|folded chair|fire alarm|power strip|calendar
poster|potted plant|luggage|mattress
"""
SCAN3R = """
armchair|bath cabinet|beam|bed|bench|blanket|blinds|book|box|bucket|cabinet|carpet|ceiling|chair
clothes|clutter|commode|computer desk|couch|couch table|counter|cupboard|curtain|cushion|desk
dining chair|dining table|door|doorframe|end table|extractor hood|floor|footstool|fridge|garbage bin
heater|kitchen cabinet|kitchen counter|kitchen towel|lamp|laundry basket|light|microwave|mirror
monitor|nightstand|ottoman|oven|pc|picture|pillow|pipe|plant|radiator|rocking chair|shelf|shoe rack
side table|sink|sofa|stair|stool|stove|table|toilet|towel|trash can|tv|tv stand|wall|wardrobe
washing machine|window|windowsill|showcase|toilet brush|clothes dryer|hanging cabinet|puf
"""


def cosine(a, b):
    return float(embed_label(a) @ embed_label(b))


def test_codes_are_orthogonal_or_cross_at_one_eighth():
    all_ = make_codes()
    assert all_.shape == (2048, DIMENSION)
    cross = np.abs(all_ @ all_.T)
    assert np.allclose(np.diag(cross), 1)
    np.fill_diagonal(cross, 0)
    assert set(np.unique(cross.round(6))) == {0.0, 0.125}
    for i in range(0, 2048, 64):
        assert not cross[i : i + 64, i : i + 64].any()


@pytest.mark.parametrize(
    "same",
    [
        "couch|sofa|settee|Couch|sofas|SOFA ", "tv|television|tv monitor|TV|tvmonitor|television set",
        "night stand|nightstand|NightStand|night_stand|nightstand 3", "shelf|shelves",
        "trash can|garbage bin|waste basket", "fridge|refrigerator|refridgerator",
        "wash basin|sink|washbasins", "picture|painting|paintings",
        "window;windowpane|window", "bed/double bed|bed", "knives|knife", "babies|person",
        "cabinet (closed)|cabinet",
    ],
)  # fmt: skip
def test_synonyms_plurals_and_spellings_are_one(same):
    first, *others = same.split("|")
    for other in others:
        assert cosine(first, other) == pytest.approx(1, abs=1e-5), other


@pytest.mark.parametrize(
    ("low", "high", "pairs"),
    [
        (0.55, 0.85, "chair|armchair, chair|office chair, armchair|office chair, stool|armchair"),
        (0.55, 0.85, "stool|office chair, cupboard|wardrobe, cabinet|wardrobe, desk|table"),
        (0.55, 0.85, "wardrobe|chest of drawers, tv|monitor, bookshelf|shelf"),
        (0.55, 0.85, "floor lamp|ceiling lamp"),
        # a word is a kind of what it ends in
        (0.75, 1.01, "leather chair|chair, leather desk chair|desk chair, tall RoomWindow|window"),
        (0.75, 1.01, "wallpicture|picture, chair with wheels|chair, pile of old books|book"),
        (0.75, 1.01, "blue-grey sofas|sofa, HouseWall|wall, microwaveoven 2|microwave oven"),
        # misspelt and unknown words are near what is spelled alike
        (0.5, 1.0, "refrigerater|fridge, armchiar|armchair, teevision|tv, wardrob|closet"),
        (0.5, 1.0, "bookshelve|bookshelf, dishwascher|dishwasher, old xylotron|xylotron"),
        (0.7, 1.0, "xylotron|xylotrons"),
        (-0.35, 0.35, "xylotron|chair"),
    ],
)
def test_words_are_as_near_as_they_are_kin(low, high, pairs):
    for pair in pairs.split(", "):
        assert low < cosine(*pair.split("|")) < high, pair


@pytest.mark.parametrize(
    "label",
    ["", " ", "unknown", "Object", "other", "others", "12", "-", "otherfurniture", "UNLABELED"],
)
def test_what_says_nothing(label):
    assert not embed_label(label).any()


@pytest.mark.parametrize(
    ("labels", "share"),
    [(NYU40, 1.0), (SCANNET200, 0.99), (COCO, 1.0), ("|".join(PASCAL[1:]), 1.0), (SCAN3R, 0.98)],
    ids=["nyu40", "scannet200", "coco", "pascal", "3rscan"],
)
def test_data_sets_are_known(labels, share):
    labels = [name for line in labels.split("\n") for name in line.split("|") if name]
    strange = [label for label in labels if not is_known_label(label)]
    assert 1 - len(strange) / len(labels) >= share, strange
    assert not any(map(is_known_label, ("refrigerater", "armchiar", "wardrob", "xylotron")))


def test_words_stand_in_one_place():
    text = importlib.resources.files("placegraph.indoor.encode").joinpath("data/things.txt")
    seen = Counter()
    for line in text.read_text("utf-8").splitlines():
        seen.update({join_words(word) for word in line.partition("#")[0].split(",")} - {""})
    assert [word for word, count in seen.items() if count > 1] == []
    assert len(load_tree().vectors) + DIMENSION <= len(make_codes())
    assert len(hash_tree()) == 8


def test_a_tree_of_ones_own():
    got = parse_tree("sea # a comment\n  boat, ship\n    tug\n\n  fish\nland\n  house\n")
    rows = {"sea": 0, "boat": 1, "ship": 1, "tug": 2, "fish": 3, "land": 4, "house": 5}
    assert got.row_of == rows
    cosines = got.vectors @ got.vectors.T
    assert np.diag(cosines) == pytest.approx(1, abs=1e-5)
    assert cosines[0, 1] == pytest.approx(GROUP, abs=1e-5)
    assert cosines[1, 2] == pytest.approx(KIN, abs=1e-5)
    assert cosines[0, 4] == 0
    assert abs(cosines[2, 5]) < 0.3
    other = parse_tree("sea\n  boat\n")
    assert other.digest != got.digest
    assert (other.vectors[1] == got.vectors[1]).all()


@given(st.text(max_size=30))
def test_any_label_has_a_unit_vector_or_none(label):
    got = embed_label(label)
    assert got.shape == (DIMENSION,)
    assert got.dtype == np.float32
    length = float(np.linalg.norm(got))
    assert length == 0 or length == pytest.approx(1, abs=1e-4)
    assert (embed_label(label) == got).all()
    assert (embed_label(f" {label.strip()} ") == got).all()
