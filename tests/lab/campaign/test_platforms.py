"""Machines of other kinds give the same answers: the quick half of the campaign's platforms."""

import pytest

from placegraph_lab.campaign import platforms
from placegraph_lab.campaign.platforms import Platform, agrees, quick, together
from placegraph_lab.campaign.processes import Told, pose_apart


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """What a process as it comes answers."""
    return Told(tmp_path_factory.mktemp("first")).first


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """Platforms by name."""
    return {p.name: p for p in quick(tmp_path_factory.mktemp("locales"))}


def test_a_turkish_machine_of_one_core_in_the_far_east(first, known):
    """Where the small letter of I is ı, a number's point is a comma, and it is tomorrow."""
    names = ("one core", "TZ far east", "locale tr_TR.UTF-8")
    assert agrees(together(*(known[n] for n in names if n in known)), first) == ""


def test_a_small_machine_that_knows_ascii_alone(first, known):
    names = ("read-only install, no home", "1 GB of memory", "locale C, ASCII")
    assert agrees(together(*(known[n] for n in names if n in known)), first) == ""


def test_a_machine_without_embree_and_poselib(first, known):
    assert agrees(known["no Embree, no PoseLib"], first) == ""


@pytest.mark.all
@pytest.mark.parametrize("name", ["locale tr_TR.ISO-8859-9", "one core", "TZ far east"])
def test_each_alone(first, known, name):
    if name not in known:
        pytest.skip(f"{name}: cannot be had on this machine")
    assert agrees(known[name], first) == ""


def test_what_differs_is_told(first):
    other = first | {"texts": first["texts"][::-1]}
    assert pose_apart(first, other) == "texts differs"
    assert "moved by" in pose_apart(first, first | {"pose": first["pose"] | {"status": "LOST"}})


def test_the_last_digits_of_another_numpy_are_not_compared(first):
    last = first | {"texts": [{"p": 2.7049333292252744}]}
    assert pose_apart(last, first | {"texts": [{"p": 2.7049333292252764}]}) == ""
    assert pose_apart(last, first | {"texts": [{"p": 2.7049334}]}) == "texts differs"


def test_platforms_add_up():
    both = together(
        Platform("a", ("--x",), {"A": "1"}, ("nice",)), Platform("b", change={"B": "2"})
    )
    assert both == Platform("a and b", ("--x",), {"A": "1", "B": "2"}, ("nice",))


def test_this_interpreter_is_found():
    assert "3.11" in platforms.pythons() or platforms.pythons()
