from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import OptionError
from placegraph.indoor.library import SceneLibrary, SearchOptions, make_library
from placegraph.indoor.library.search import WORDS, encode_frames, score_scenes
from placegraph.io.capture.frame import Frame
from placegraph_lab.worlds.home.change import change_home
from placegraph_lab.worlds.home.home import scene_of


@pytest.mark.parametrize("name", ["parlour", "study", "bedroom"])
@pytest.mark.parametrize("method", ["likelihood", "cosines"])
def test_a_room_is_found_among_three(by_labels, rooms, name, method):
    estimate = by_labels.search(rooms[name].film(3), options=SearchOptions(method=method))
    assert estimate.best.scene == name
    assert len(estimate.modes) == 3
    total = sum(m.probability for m in estimate.modes) + estimate.elsewhere
    assert total == pytest.approx(1.0)
    if method == "likelihood":
        assert estimate.best.probability > 0.5


def test_more_frames_make_sure(by_labels, rooms):
    film = rooms["bedroom"].film(3, frames=16)
    told = [by_labels.search(film, frames=slice(n)).best.probability for n in (1, 4, 16)]
    assert told[2] > told[0]
    assert told[2] > 0.7


def test_a_room_is_found_when_things_have_moved(by_labels, rooms):
    room = rooms["study"]
    moved = replace(room, interior=change_home(room.interior, np.random.default_rng(2)))
    assert by_labels.search(moved.film(5, frames=8)).best.scene == "study"


def test_two_of_the_same_room_are_ambiguous(maps, rooms):
    twins = make_library({"here": maps["study"], "there": maps["study"]}, encoders="labels")
    estimate = twins.search(rooms["study"].film(3))
    assert estimate.status is Status.AMBIGUOUS
    assert estimate.modes[0].probability == pytest.approx(estimate.modes[1].probability)
    assert "there" in estimate.reason
    assert "here" in estimate.reason


@pytest.mark.parametrize("missing", ["parlour", "study", "bedroom"])
@pytest.mark.parametrize("seed", [3, 4])
def test_a_room_that_is_not_there_is_not_found(maps, rooms, missing, seed):
    others = {n: m for n, m in maps.items() if n != missing}
    film = rooms[missing].film(seed, frames=8)
    for encoders in ("labels", ("labels", "appearance")):
        estimate = make_library(others, encoders=encoders).search(film)
        assert estimate.status is not Status.OK
    alone = make_library({n: others[n] for n in list(others)[:1]}, encoders="labels")
    estimate = alone.search(film)
    assert estimate.status is Status.LOST
    assert estimate.elsewhere > estimate.best.probability


def test_blank_images_are_of_nowhere(maps, rooms):
    library = make_library(maps, encoders="appearance")
    rng = np.random.default_rng(0)
    frame = rooms["study"].film(3, frames=1, labels=None)[0]
    for image in (np.zeros((72, 96, 3)), rng.integers(0, 256, (72, 96, 3))):
        odd = Frame.from_arrays(image.astype(np.uint8), camera=frame.camera)
        try:
            estimate = library.search([odd])
        except OptionError as error:
            assert "nothing to compare" in str(error)  # noqa: PT017  # either is right
        else:
            assert estimate.status is not Status.OK


def test_evidence_names_what_was_seen(by_labels, rooms):
    estimate = by_labels.search(rooms["bedroom"].film(3))
    told = [o.label for e in estimate.evidence if e.verdict == "for" for o in e.objects]
    assert {"bed", "wardrobe"} & set(told)
    plain = estimate.to_dict()
    assert plain["modes"][0]["scene"] == "bedroom"
    assert plain["stats"]["frames"] == 6


def test_a_thing_taken_for_another_in_every_frame_is_one_witness(by_labels, rooms):
    film = rooms["study"].film(3, frames=8)
    wrong = next(i for i, n in film.label_names.items() if n == "wall")
    called = [replace(f, label_names=f.label_names | {wrong: "bathtub"}) for f in film]
    maps = {name: by_labels.scene(name) for name in by_labels}
    named = replace(maps["bedroom"].graph, labels=tuple(
        "bathtub" if n == "wardrobe" else n for n in maps["bedroom"].graph.labels
    ))  # fmt: skip
    maps["bedroom"] = replace(maps["bedroom"], graph=named)
    assert make_library(maps, encoders="labels").search(called).best.scene == "study"


def test_the_same_question_has_the_same_answer(by_labels, rooms):
    film = rooms["study"].film(4)
    once, again = (by_labels.search(film).to_dict() for _ in range(2))
    for told in (once, again):
        del told["stats"]
    assert once == again


def test_what_cannot_be_searched(by_labels, rooms):
    film = rooms["study"].film(4)
    assert by_labels.search(film, frames=[2]).stats["frames"] == 1
    unlabelled = rooms["study"].film(4, labels=None)
    for words, ask in (
        ("most", lambda: by_labels.search(film, most=0)),
        ("nothing to compare by labels", lambda: by_labels.search(unlabelled)),
        ("empty; add a scene", lambda: SceneLibrary("labels").search(film)),
        ("at least one", lambda: SceneLibrary(())),
        ("without repetitions", lambda: SceneLibrary(("labels", "labels"))),
    ):
        with pytest.raises(OptionError, match=words):
            ask()


@pytest.mark.parametrize(
    ("name", "value"),
    [("method", "votes"), ("wrong", 1.0), ("max_frames", 0), ("finalists", 0), ("patches_per_frame", 0)],
)  # fmt: skip
def test_options_out_of_range(name, value):
    with pytest.raises(OptionError, match=name):
        SearchOptions(**{name: value})


@pytest.mark.parametrize("name", ["labels", "appearance"])
def test_the_papers_sum_is_the_papers_sum(maps, rooms, name):
    library = make_library(maps, encoders=name)
    (encoder,), film = library.encoders, list(rooms["parlour"].film(6, frames=10))
    wanted = np.zeros(3)
    for frame in film:
        patches = encoder.patches(frame).reshape(-1, encoder.dimension).astype(np.float64)
        patches = patches[patches.any(axis=1)]
        for s, scene in enumerate(library):
            vectors = library.entry(scene).signature.vectors[encoder.key]
            wanted[s] += (patches @ vectors.T).max(axis=1).mean()
    query = encode_frames(film, library.encoders, exact=True)
    got = score_scenes(library.own_index, query, SearchOptions(method="cosines")).total
    np.testing.assert_allclose(got, wanted, atol=1e-6)
    found = library.search(film, options=SearchOptions(method="cosines"))
    assert {m.scene: m.score for m in found.modes} == dict(zip(library, got.tolist(), strict=True))
    assert (len(query.parts[0].words) > WORDS) == (name == "appearance")


def test_where_things_stand_tells_rooms_of_the_same_things_apart(rooms):
    study = rooms["study"]
    flat = replace(study.flat, rows=tuple(row[::-1] for row in study.flat.rows))
    interior = flat.furnish(np.random.default_rng(1))
    mirror = replace(study, flat=flat, interior=interior, scene=scene_of(interior))
    library = make_library({"study": study.scene, "mirror": mirror.scene}, encoders="labels")
    for name, room in (("study", study), ("mirror", mirror)):
        film = room.film(11, frames=10)
        assert library.search(film).best.scene == name
        query = encode_frames(list(film), library.encoders)
        gap = {
            geometry: np.ptp(
                score_scenes(library.index, query, SearchOptions(geometry=geometry)).total[:2]
            )
            for geometry in (False, True)
        }
        assert gap[True] > 3.0 * gap[False]


def test_a_large_library_is_shortlisted(by_labels, rooms):
    index = by_labels.index
    rows = np.array([0, 2])
    part = index.subset(rows)
    for new, old in enumerate(rows):
        for key, v in part.vocabularies.items():
            whole = index.vocabularies[key]
            one, two = (
                x.vectors[x.code[i.starts[r] : i.starts[r + 1]]]
                for x, i, r in ((v, part, new), (whole, index, old))
            )
            np.testing.assert_array_equal(one, two)
    query = encode_frames(list(rooms["bedroom"].film(3)), by_labels.encoders)
    means = {s.key: s.words[s.word].mean(axis=0) for s in query.parts}
    assert by_labels.names.index("bedroom") in index.nearest(means, 2)
    full = score_scenes(index, query, SearchOptions(geometry=False)).total
    some = score_scenes(part, query, SearchOptions(geometry=False)).total
    np.testing.assert_allclose(full[rows], some, rtol=1e-3)
