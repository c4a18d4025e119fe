import pytest

from placegraph_lab.campaign.platforms import (
    Platform,
    Reference,
    check_platform,
    combine,
    compare_poses,
    quick,
)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    return Reference(tmp_path_factory.mktemp("first")).answers


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return {p.name: p for p in quick(tmp_path_factory.mktemp("locales"))}


@pytest.mark.all
def test_a_turkish_machine_of_one_core_in_the_far_east(first, known):
    names = ("one core", "TZ far east", "locale tr_TR.UTF-8")
    assert check_platform(combine(*(known[n] for n in names if n in known)), first) == ""


@pytest.mark.all
def test_a_machine_without_embree_and_poselib(first, known):
    assert check_platform(known["no Embree, no PoseLib"], first) == ""


def test_what_differs_is_described():
    pose = {"status": "OK", "modes": [{"map_from_camera": [[1.0, 0.0], [0.0, 1.0]]}]}
    first = {"texts": ["a", "b"], "pose": pose}
    assert compare_poses(first, first | {"texts": ["b", "a"]}) == "texts differs"
    assert "moved by" in compare_poses(first, first | {"pose": pose | {"status": "LOST"}})
    moved = pose | {"modes": [{"map_from_camera": [[1.0, 0.0], [9.0, 1.0]]}]}
    assert "moved by 9.0000, OK" in compare_poses(first, first | {"pose": moved})


def test_platforms_add_up():
    both = combine(Platform("a", ("--x",), {"A": "1"}, ("nice",)), Platform("b", change={"B": "2"}))
    assert both == Platform("a and b", ("--x",), {"A": "1", "B": "2"}, ("nice",))
