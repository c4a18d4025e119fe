"""What labels say of objects: built in, nameless, the same."""

import pytest

from placegraph.indoor.map.structure import nameless, same_label, structure


def test_the_last_word_says_what_is_built_in():
    assert structure(["HouseWall", "wall clock", "floor", "", "RoomWindow"]).tolist() == [
        True, False, True, False, True,
    ]  # fmt: skip


@pytest.mark.parametrize("label", ["", "unknown", "Object", "object 3", "17", "Mesh_01", "none"])
def test_words_that_name_nothing(label):
    assert nameless(label)
    assert same_label(label, "chair")
    assert same_label("chair", label)


@pytest.mark.parametrize("label", ["chair", "unknown chair", "other furniture", "椅子"])
def test_words_that_do(label):
    assert not nameless(label)
    assert same_label(label, label.upper())
    assert not same_label(label, "lamp")
