import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.map.names import CLOSE, LONGEST, NameIndex

NAMES = [
    "Café de l'Étoile", "Ripley's Aquarium of Canada", "Ripley's", "The Rex Theatre",
    "E Carson Street", "Place du Casino", "Straße des 17. Juni", "Москва", "7-Eleven", "— · —",
    "Casino",
]  # fmt: skip


class Objects:
    def __init__(self, *names):
        self.names = names


@pytest.fixture(scope="module")
def index():
    return NameIndex.build(Objects(*NAMES))


def row(name):
    return NAMES.index(name)


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("Café de l'Étoile", "Café de l'Étoile"), ("cafe de l’etoile", "Café de l'Étoile"),
        ("CAFE DE LETOILE", "Café de l'Étoile"),
        ("Ripley's_Aquarium_of_Canada", "Ripley's Aquarium of Canada"),
        ("ripleys aquarium of canada", "Ripley's Aquarium of Canada"), ("Ripley´s", "Ripley's"),
        ("Rex Theater", "The Rex Theatre"), ("the rex theatre", "The Rex Theatre"),
        ("East Carson St", "E Carson Street"), ("e. carson street", "E Carson Street"),
        ("the Place du Casino", "Place du Casino"), ("pl. du casino", "Place du Casino"),
        ("Strasse des 17 Juni", "Straße des 17. Juni"), ("москва", "Москва"),
        ("7 eleven", "7-Eleven"),
    ],
)  # fmt: skip
def test_named(written, name, index):
    assert index.find_rows(written) == {row(name): 1.0}


@pytest.mark.parametrize("written", ["", " ", "—", "the", "Place", "Cat", "Avenue", "😀"])
def test_not_named(written, index):
    assert index.find_rows(written) == {}


def test_not_every_pub_is_the_pub():
    index = NameIndex.build(Objects("The Pub"))
    assert index.longest_name(["pub"], 0) == 0
    assert index.find_rows("The Pub") == {0: 1.0}


TOWN = [
    "Starbucks", "HSBC", "The Crown Inn", "MetLife Building", "Tiffany & Co.", "West 43rd Street",
    "East 43rd Street", "West Houston Street", "Kips Bay Tower North", "Kips Bay Tower South",
    "Kips Bay Deli", "Kips Bay", "Carson", "Ulica Floriańska", "Sloterdijk Station", "Hauptstraße",
    "5th Avenue", "New York Public Library", "Wood Street Garage", "Bank of America",
]  # fmt: skip


@pytest.mark.parametrize(
    ("written", "names"),
    [
        ("Starbucks Cafe", "Starbucks"),
        ("Starbucks coffee shop", ""),  # two words more may be a name of their own
        ("HSBC UK", "HSBC"),
        ("Bank of America ATM", "Bank of America"),
        ("the Crown", "The Crown Inn"),
        ("Met Life", "MetLife Building"),
        ("MetLife", "MetLife Building"),
        ("Tiffany's", "Tiffany & Co."),
        ("West 43 Street", "West 43rd Street"),
        ("West 43th St.", "West 43rd Street"),
        ("W 43rd", "West 43rd Street"),
        ("44th Street", ""),
        ("Houston Street", "West Houston Street"),
        ("Kips Bay Towers", "Kips Bay Tower North, Kips Bay Tower South"),
        ("Kips Bay", "Kips Bay"),
        ("Carson Street", ""),  # "Carson" is a shop
        ("Wood Street", ""),  # nor is a garage a street
        ("ulicy Floriańskiej", "Ulica Floriańska"),
        ("Sloterdijk", "Sloterdijk Station"),
        ("Hauptstr.", "Hauptstraße"),
        ("Fifth Ave", "5th Avenue"),
        ("New York library", "New York Public Library"),
        ("Hudson Library", ""),
    ],
)
def test_names_in_part(written, names):
    found = NameIndex.build(Objects(*TOWN)).find_rows(written)
    assert {TOWN[i] for i in found} == set(filter(None, names.split(", ")))


def test_house_numbers():
    names = ["125 Main Street", "127a Main Street", "Main Street", "West 38th Street", "7th Inn"]
    index = NameIndex.build(Objects(*names))
    assert index.find_rows("125 Main St.") == {0: 1.0}
    assert index.find_rows("128 Main Street") == {2: 0.5}, "the map lacks the house, not the street"
    assert index.find_rows("Main Street") == {2: 1.0}, "no house of it"
    assert set(index.find_rows("W. 38th")) == {3}
    assert index.find_rows("7th") == {}, "a number alone is a street"


def test_a_part_of_many_names_means_each_of_them_less():
    index = NameIndex.build(Objects("Rex Tower", "Elm House", *(f"Elm {i}" for i in range(9))))
    (one,), several = index.find_rows("Rex").values(), index.find_rows("Elm").values()
    assert max(several) < one < 1.0


def test_one_name_of_several_objects_and_spellings():
    index = NameIndex.build(Objects("Casino", "casino", "CASINO!", "Kasino"))
    assert index.find_rows("casino") == {0: 1.0, 1: 1.0, 2: 1.0}


def test_the_longest_name_wins(index):
    words = tokens("Near Ripley's Aquarium of Canada and Ripley's there is a Casino.")
    found = {start: n for start in range(len(words)) if (n := index.longest_name(words, start))}
    assert found == {words.index("ripleys"): 4, words.index("and") + 1: 1, len(words) - 1: 1}


def test_no_name_beyond_the_end_of_the_text(index):
    assert index.longest_name(tokens("Ripley's Aquarium of"), 0) == 1
    assert index.longest_name(["aquarium"], 0) == 0
    assert index.longest_name(tokens("Place du"), 0) == 0


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("Ripleys Aquarum of Canada", "ripleys aquarium of canada"),
        ("Plce du Casino", "pl du casino"),
        ("Cafe de l'Etoille", "cafe de letoile"),
    ],
)
def test_misspelt_names(written, name, index):
    found, similarity = index.closest_name(written)
    assert found == name
    assert CLOSE <= similarity < 1
    assert index.closest_name(written) == (found, similarity), "remembered"


@pytest.mark.parametrize("written", ["", "—", "Zoo", "Aquarium", "qqqqqqqq"])
def test_nothing_close(written, index):
    assert index.closest_name(written) is None


def test_a_map_without_names():
    index = NameIndex.build(Objects())
    assert index.find_rows("Casino") == {}
    assert index.closest_name("Casino") is None
    assert index.longest_name(["casino"], 0) == 0


@given(st.lists(st.text(max_size=30), max_size=8))
def test_every_name_is_found_as_written(names):
    index = NameIndex.build(Objects(*names))
    for i, name in enumerate(names):
        words = tokens(name)
        if not words:
            continue
        assert i in index.find_rows(name)
        if len(words) <= LONGEST:
            assert index.longest_name([*words, "zzz"], 0) == len(words)
