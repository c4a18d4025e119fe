"""Sentences, frames and fixes, each alone and together, in a world of two towns."""

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.status import decide_joined
from placegraph.outdoor.city import build_city
from placegraph.outdoor.search.ask import NO, YES
from placegraph.world import World
from placegraph_lab.worlds.town.town import Town

OUTSIDE = "A church is south of me and Lange Straße is south of me. A bakery is east of me."


@pytest.fixture(scope="module")
def west(world):
    """The world without its eastern town."""
    return World({"west": world.cities["west"]}, world.scenes)


def test_a_library_on_its_street_is_found_by_frames_and_a_sentence(world, films):
    text = "I am in the library on Lange Straße"
    estimate = world.locate(text, films["study"], frames=slice(3), seed=0)
    best = estimate.best
    assert (estimate.status, best.scene, best.building) == (Status.OK, "reading", "Stadtbibliothek")
    assert (best.room, best.level, best.earth.room) == ("study", "0", "study")
    assert best.longitude == pytest.approx(9.99, abs=0.01)
    assert best.earth.geopose()["position"]["lat"] == pytest.approx(best.latitude)
    assert json.loads(json.dumps(estimate.to_dict()))["modes"][0]["scene"] == "reading"
    points = [f for f in estimate.geojson()["features"] if f["properties"]["kind"] == "mode"]
    assert points[0]["geometry"]["coordinates"][0] == pytest.approx(best.longitude)


@pytest.mark.parametrize(
    ("text", "scene"), [("I am in the hotel", "suite"), ("I am at Lange Straße 7", "twin")]
)
def test_a_sentence_tells_twins_apart(world, films, text, scene):
    frames = films["parlour"]
    alone = world.locate(None, frames)
    assert alone.status is Status.AMBIGUOUS
    assert {m.scene for m in alone.modes} == {"suite", "twin"}
    estimate = world.locate(text, frames)
    assert (estimate.status, estimate.best.scene) == (Status.OK, scene)
    for found in (alone, estimate):  # the reason speaks of the list
        shares = [m.probability for m in found.modes]
        assert shares == sorted(shares, reverse=True)
        assert re.findall(r"(\d+)% of the probability within", found.reason) == [
            f"{100 * shares[0]:.0f}"
        ]
        assert found.best.where in found.reason


def test_frames_tell_towns_apart(world, films):
    text = "I am in the library on Lange Straße"
    alone = world.locate(text)
    assert alone.status is Status.AMBIGUOUS
    assert {"reading", "stacks"} <= {m.scene for m in alone.modes}
    estimate = world.locate(text, films["bedroom"])
    assert (estimate.status, estimate.best.scene) == (Status.OK, "stacks")


def test_a_fix_tells_towns_and_twins_apart_but_picks_nothing_alone(world, films):
    anchor = world.scenes["suite"].anchors[0]
    near = (anchor.longitude, anchor.latitude)
    estimate = world.locate(None, films["parlour"], near=near, radius=15.0)
    assert (estimate.status, estimate.best.scene) == (Status.OK, "suite")
    alone = world.locate(near=near, radius=15.0)
    assert (alone.status, alone.best.scene) == (Status.AMBIGUOUS, "suite")
    assert world.locate(near=(2.35, 48.85), radius=100.0).status is Status.LOST
    turned = world.locate(near=near[::-1], radius=15.0)
    assert turned.status is Status.LOST
    assert f"longitude comes first, {near[0]},{near[1]}" in turned.reason


@pytest.mark.parametrize(
    "known",
    [
        {"text": "I am in the café"},  # where no map is
        {"near": (13.40, 52.52), "radius": 500.0},  # in the other town
        {"heading": True},  # the other way
    ],
    ids=str,
)
def test_what_contradicts_frames_lowers_the_status(world, films, known):
    plain = world.locate(None, films["study"])
    assert plain.status is Status.OK
    if "heading" in known:
        known = {"heading": plain.best.earth.heading + np.pi}
        same = world.locate(None, films["study"], heading=plain.best.earth.heading)
        assert same.status is Status.OK
    estimate = world.locate(known.pop("text", None), films["study"], **known)
    assert (estimate.status, estimate.best.scene) == (Status.AMBIGUOUS, "reading")
    assert "But" in estimate.reason


def test_text_of_the_outside_alone_is_as_in_the_city(world, west):
    one, alone = west.locate(OUTSIDE), world.cities["west"].locate(OUTSIDE)
    assert (one.status, one.reason) == (alone.status, alone.reason)
    assert [m.probability for m in one.modes] == [m.probability for m in alone.modes]
    assert one.next_question(world) is None or one.status is Status.AMBIGUOUS


def test_frames_alone_are_as_in_the_library(world, films):
    alone = world.library.localize(films["study"])
    estimate = world.locate(None, films["study"])
    assert estimate.status is alone.status
    np.testing.assert_allclose(estimate.best.pose.map_from_camera, alone.best.map_from_camera)


@pytest.mark.parametrize(
    "text",
    [
        "Ich bin in der Stadtbibliothek. Da ist ein Schreibtisch neben einem Bücherregal.",
        "I am in the Stadtbibliothek. There is a desk and a bookcase.",
    ],
)
def test_text_alone_names_building_and_room_where_it_can(west, text):
    estimate = west.locate(text)
    assert (estimate.status, estimate.best.scene, estimate.best.room) == (
        Status.OK,
        "reading",
        "study",
    )
    assert estimate.understood.to_dict()["inside"]
    assert "against" not in {e.verdict for e in estimate.best.evidence}


def test_a_film_of_nowhere_is_not_named(world, films):
    fewer = World(world.cities, {n: world.scenes[n] for n in ("suite", "stacks")})
    assert fewer.locate(None, films["study"]).status is not Status.OK


def test_photos_are_not_compared_with_maps_without_colours(rooms):
    def strip_colours(scene):
        mesh = Mesh.plain(scene.mesh.vertices, scene.mesh.triangles, scene.mesh.object_of)
        return replace(scene, mesh=mesh, encoded=(b"",))

    photo = rooms["study"].film(21, 2, labels=None)
    grey = {name: strip_colours(rooms[name].scene) for name in ("parlour", "bedroom")}
    with pytest.raises(OptionError, match="the map has no colours"):
        World({}, grey).locate(None, photo, refine=False)
    estimate = World({}, {**grey, "study": rooms["study"].scene}).locate(None, photo, refine=False)
    assert list(estimate.poses) == ["study"]


def test_what_cannot_be_asked(world, films):
    asked = {"frames": slice(3), "text": "a desk"}
    for bad in ({}, asked, {"near": (99, 99)}, {"near": (9, 9), "radius": -1}):
        with pytest.raises(OptionError):
            world.locate(**bad)
    with pytest.raises(OptionError, match=r"not an option of World\.locate; did you mean budget\?"):
        world.locate("a desk", bugdet=1.0)
    with pytest.raises(OptionError, match="no scene map"):
        World(world.cities).locate(capture=films["study"])
    noted = World(world.cities).locate("I am in the library", films["study"])
    assert noted.notes
    assert noted.best.building == "Stadtbibliothek"


def test_an_answer_is_short_and_travels(world, films):
    estimate = world.locate("I am in the hotel", films["parlour"], refine=False)
    assert len(repr(estimate)) < 300
    sent = pickle.dumps(estimate)
    assert len(sent) < 100_000
    assert pickle.loads(sent).to_dict() == estimate.to_dict()  # noqa: S301 - our own


def test_questions_tell_twins_apart_and_a_no_is_no_yes(world, films):
    alone = world.locate(None, films["parlour"], refine=False)
    question = alone.next_question(world)
    asked = question.subjects[0].words
    assert question.text == f"Are you in {asked}?"
    for option, there in (("yes", True), ("no", False)):
        estimate = world.locate(
            None, films["parlour"], refine=False, answers=[question.answer(option)]
        )
        assert (estimate.best.building == asked) == there
        assert estimate.next_question(world) is None or estimate.status is Status.AMBIGUOUS
    answers = [question.answer("don't know")]
    unknown = world.locate(None, films["parlour"], refine=False, answers=answers)
    assert unknown.status is Status.AMBIGUOUS
    assert unknown.next_question(world).text != question.text


@pytest.mark.parametrize(
    "text", ["Ich bin neben dem Tisch.", "I am near a table.", "Estoy al lado de la mesa."]
)
def test_an_answer_about_a_building_decides_and_changes_no_language(world, text):
    alone = world.locate(text)
    question = alone.next_question(world)
    before = {m.scene: m.probability for m in alone.modes}
    name = question.subjects[0].words
    for option, least, most in ((YES, 0.9, 1.0), (NO, 0.0, 0.2)):
        found = world.locate(text, answers=[question.answer(option)])
        there = sum(m.probability for m in found.modes if m.building == name)
        assert least <= there <= most, (option, before)
        assert found.understood.language == alone.understood.language
        evidence = [e for m in found.modes for e in m.evidence if m.building == name]
        assert any(question.text in e.statement for e in evidence) or option == NO
        again = found.next_question(world)
        assert again is None or question.text != again.text


def test_other_images_make_a_pose_sure_that_only_another_scene_kept_from_it(world, films):
    alone = world.locate(None, films["parlour"], refine=False)
    left = [0.01] * (len(alone.modes) - 1)
    joined = decide_joined(alone, [0.95, *left])
    assert (alone.status, joined.status) == (Status.AMBIGUOUS, Status.OK)
    assert "holds 95% of the probability" in joined.reason
    assert "nearly as well" not in joined.reason
    assert decide_joined(alone, [0.8, *left]).status is Status.AMBIGUOUS
    denied = world.locate("I am in the bakery", films["parlour"], refine=False)
    shares = [0.95] + [0.01] * (len(denied.modes) - 1)
    assert decide_joined(denied, shares).status is Status.AMBIGUOUS


def test_a_street_of_another_town_speaks_against_rooms_of_this_one(world, tmp_path):
    drawing = "[town]\ncenter = 7.4 43.7\n[drawing]\n--1-----\n  b\n[legend]\n"
    legend = "1 road: highway=residential name=Corniche Road\nb: amenity=cafe\n"
    osm = Town.parse(drawing + legend).write_osm(tmp_path / "south.osm")
    south = build_city(osm, tmp_path / "south.city")
    three = World({**world.cities, "south": south}, world.scenes)
    text = "I am in a hotel on Corniche Road."
    before, after = world.locate(text), three.locate(text)
    rooms = [sum(m.probability for m in e.modes if m.scene) for e in (before, after)]
    assert rooms[0] > 0.5
    assert rooms[1] < 0.5
    assert not any(re.search(r"\d\.\d", e.reason) for e in (before, after))  # no coordinates
    assert after.best.longitude == pytest.approx(7.4, abs=0.1)


def test_what_one_of_two_towns_says_of_itself_is_not_said_of_all(world):
    estimate = world.locate(OUTSIDE)  # the towns are the same
    assert estimate.status is Status.AMBIGUOUS
    assert estimate.best.probability < 0.6
    assert f"only {estimate.best.probability:.0%} of the probability" in estimate.reason


def test_rooms_are_asked_for_where_the_building_is_known(world):
    estimate = World(world.cities, {"suite": world.scenes["suite"]}).locate("I am in the hotel")
    question = estimate.next_question(world)
    assert question is None or "Hotel Hansa" not in question.text


def test_contradictions_are_told_of_what_is_ambiguous_too(world, films):
    estimate = world.locate("I am in the bakery", films["parlour"], refine=False)
    assert estimate.status is Status.AMBIGUOUS
    assert "the description of the outside does not fit" in estimate.reason


def test_a_pose_in_a_merged_map_stands_where_its_own_part_does(world, films):
    parts = {name: world.scenes[name] for name in ("suite", "reading")}
    merged = World({"west": world.cities["west"]}, {"both": merge_scenes(parts)})
    for film, building in (("parlour", "Hotel Hansa"), ("study", "Stadtbibliothek")):
        best = merged.locate(capture=films[film], refine=False).best
        assert (best.building, best.earth.building) == (building, building)
    suite = parts["suite"].anchors[0]
    near = merged.locate(near=(suite.longitude, suite.latitude), radius=15.0)
    assert near.best.building == "Hotel Hansa"
