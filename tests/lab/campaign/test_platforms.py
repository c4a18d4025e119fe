"""Machines of other kinds give the same answers: the quick half of the campaign's platforms."""

import pytest

from placegraph_lab.campaign.platforms import Platform, Told, agrees, pose_apart, quick, together


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


@pytest.mark.all
def test_a_machine_without_embree_and_poselib(first, known):
    assert agrees(known["no Embree, no PoseLib"], first) == ""


def test_what_differs_is_told(first):
    other = first | {"texts": first["texts"][::-1]}
    assert pose_apart(first, other) == "texts differs"
    assert "moved by" in pose_apart(first, first | {"pose": first["pose"] | {"status": "LOST"}})


def test_platforms_add_up():
    both = together(
        Platform("a", ("--x",), {"A": "1"}, ("nice",)), Platform("b", change={"B": "2"})
    )
    assert both == Platform("a and b", ("--x",), {"A": "1", "B": "2"}, ("nice",))
