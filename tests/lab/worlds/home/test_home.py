import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.change import KINDS, ROOMS, SHELL, SYNONYMS
from placegraph_lab.worlds.home.home import (
    CAMERA,
    STYLES,
    change_home,
    draw_home,
    home,
    record,
    scene_of,
    visit,
)

SEEDS = st.integers(0, 10**6)
WORDS = {word for plain in KINDS for word in SYNONYMS.get(plain, (plain,))} | SHELL
FEW = settings(max_examples=15)


def _furnished(seed):
    rng = np.random.default_rng(seed)
    flat = home(rng)
    return flat, flat.furnish(rng), rng


@given(SEEDS, st.sampled_from(sorted(STYLES)))
@FEW
def test_every_home_parses_and_the_same_seed_draws_the_same(seed, style):
    text = draw_home(np.random.default_rng(seed), style)
    assert draw_home(np.random.default_rng(seed), style) == text
    flat = Flat.parse(text)
    assert 1 <= len(flat.rooms) <= 3
    assert {room.name for room in flat.rooms} <= ROOMS.keys()
    assert len({room.name for room in flat.rooms}) == len(flat.rooms)
    assert {blot.symbol.label for blot in flat.objects} <= WORDS


@given(SEEDS)
@settings(max_examples=6)
def test_things_stay_in_their_rooms_and_no_two_in_one_place(seed):
    _, interior, rng = _furnished(seed)
    for state in (interior, change_home(interior, rng)):
        floors = {t.room: t.bounds for t in state.objects if t.label == "floor"}
        standing = [
            t
            for t in state.objects
            if t.label not in SHELL and t.bounds[0, 2] < 0.005 and t.bounds[1, 2] > 0.05
        ]
        for thing in standing:
            low, high = thing.bounds[:, :2]
            floor = floors[thing.room][:, :2]
            assert (low >= floor[0] - 1e-6).all()
            assert (high <= floor[1] + 1e-6).all()
        boxes = np.array([t.bounds for t in standing])
        for i, box in enumerate(boxes):
            overlap = np.minimum(box[1], boxes[:i, 1]) - np.maximum(box[0], boxes[:i, 0])
            # handles stand out of fronts by 3 cm
            assert not (overlap > 0.035).all(axis=1).any()


@given(SEEDS)
@settings(max_examples=6)
def test_months_later(seed):
    _, interior, _ = _furnished(seed)
    one, other = (change_home(interior, np.random.default_rng(seed)) for _ in range(2))
    assert [t.id for t in one.objects] == [t.id for t in other.objects]
    assert all(
        (a.bounds == b.bounds).all() for a, b in zip(one.objects, other.objects, strict=True)
    )
    later = {t.id: t for t in one.objects}
    before = {t.id: t for t in interior.objects}
    assert len(later) == len(one.objects)
    for thing in interior.objects:
        # what stands on a thing that is not built in went with it
        if thing.label in SHELL:
            assert later[thing.id] is thing
    assert all(t.label in WORDS for i, t in later.items() if i not in before)


def test_the_map_of_a_home():
    _, interior, _ = _furnished(3)
    scene = scene_of(interior)
    assert scene.graph.ids == tuple(str(t.id) for t in interior.objects)
    assert scene.graph.labels == tuple(t.label for t in interior.objects)
    boxes = np.array([t.bounds for t in interior.objects])
    assert np.allclose(scene.graph.positions, boxes.mean(axis=1), atol=1e-3)
    assert {a["room"] for a in scene.attributes} == {t.room for t in interior.objects}
    assert "standing on" in scene.graph.relations
    assert scene.has_colours
    later = change_home(interior, np.random.default_rng(0), moved=0, removed=0.5, added=0)
    fewer = scene_of(later, name="later")
    assert len(fewer) == len(later.objects) < len(scene)
    assert fewer.scenes == ("later",)


def test_a_capture_in_memory():
    flat, interior, rng = _furnished(8)
    walk = visit(flat, interior, rng, frames=4)
    one = record(interior, walk, np.random.default_rng(1), depth=True)
    other = record(interior, walk, np.random.default_rng(1), depth=True)
    assert len(one) == 4
    last, same = one[3], other[3]
    assert np.array_equal(last.depth(), same.depth(), equal_nan=True)
    _ = other[0].rgb()  # what was asked for before makes no difference
    assert np.array_equal(last.rgb(), same.rgb())
    assert last.rgb().shape == (CAMERA.height, CAMERA.width, 3)
    assert last.rgb() is last.rgb()
    values = np.unique(last.labels())
    assert {last.label_names[v] for v in values.tolist() if v >= 0} <= {
        t.label for t in interior.objects
    }
    assert np.allclose(np.linalg.norm(one.gravity, axis=1), 1.0)
    # odometry begins level, at its own origin
    assert np.allclose(one.odometry[0, :3, 3], 0.0)
