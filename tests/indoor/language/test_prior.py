from dataclasses import replace

import numpy as np
import pytest

from placegraph.indoor.language import read
from placegraph.indoor.language.prior import WRONG, evidence, find_unused, prior
from placegraph.indoor.language.sight_kernels import (
    dilate_profile,
    look_around_for,
    look_for,
    vote_rooms,
)
from placegraph.indoor.map.free_space import decode_ranges
from placegraph.indoor.map.map_kernels import AZIMUTHS, ELEVATIONS, STEP, Panoramas
from placegraph.indoor.options import PoseSearchOptions


@pytest.fixture(scope="module")
def table(flat):
    return flat.visibility(PoseSearchOptions(heights=(1.6,)))


def where(scene, label):
    """Boxes (n, 2, 2) on the floor of all objects of a label."""
    rows = [i for i, own in enumerate(scene.graph.labels) if own == label]
    half = scene.graph.extents[rows, :2] / 2
    return np.stack(
        [scene.graph.positions[rows, :2] - half, scene.graph.positions[rows, :2] + half], 1
    )


def away(scene, label, points):
    """Distance (K,) of points to the nearest box of a label [m]."""
    boxes = where(scene, label)
    gaps = np.maximum(boxes[:, :1] - points[None, :, :2], points[None, :, :2] - boxes[:, 1:])
    return np.linalg.norm(np.maximum(gaps, 0.0), axis=2).min(axis=0)


def best(prior, share=0.01):
    order = np.argsort(-prior, axis=None, kind="stable")[: int(share * prior.size)]
    return np.unravel_index(order, prior.shape)


def test_next_to_the_sofa(flat, table):
    logs = prior(read("next to the sofa"), flat, table)
    assert logs.shape == (len(table), AZIMUTHS)
    assert logs.dtype == np.float32
    near = logs[:, 0] > 1.0
    assert 0 < near.sum() < 0.2 * len(table)
    assert (away(flat, "sofa", table.positions[near]) < 1.5).all()
    assert (logs == logs[:, :1]).all()  # nothing is said of where one looks


def test_facing_the_toilet(flat, table):
    k, a = best(prior(read("facing the toilet"), flat, table))
    to = where(flat, "toilet")[0].mean(axis=0) - table.positions[k, :2]
    off = np.arctan2(to[:, 1], to[:, 0]) - a * STEP
    off = np.abs((off + np.pi) % (2 * np.pi) - np.pi)
    assert np.median(off) < np.deg2rad(20)
    assert (off < np.deg2rad(35)).mean() > 0.9  # who stands beside it sees half the room full of it
    assert (np.linalg.norm(to, axis=1) < 6.0).all()


def test_left_is_right_after_half_a_turn(flat, table):
    left, right, behind = (
        prior(read(f"the bed is {way}"), flat, table)
        for way in ("on my left", "on my right", "behind me")
    )
    assert np.allclose(left, np.roll(right, AZIMUTHS // 2, axis=1), atol=1e-5)
    assert np.allclose(left, np.roll(behind, AZIMUTHS // 4, axis=1), atol=1e-5)


@pytest.mark.parametrize(
    ("text", "room"),
    [("in the bathroom", "bathroom"), ("I am in the kitchen.", "kitchen"),
     ("between the bathtub and the toilet", "bathroom"), ("next to the bed", "bedroom"),
     ("2 m from the toilet", "bathroom"), ("to the right of the toilet is a washbasin", "bathroom"),
     ("the washing machine is in front of the washbasin", "bathroom"),
     ("facing the plant on the dresser, in the bedroom", "bedroom")],
)  # fmt: skip
def test_the_room_is_right(flat, table, text, room):
    logs = prior(read(text), flat, table)
    inside = np.array([a.get("room") == room for a in flat.attributes])
    floor = next(i for i in np.flatnonzero(inside) if flat.graph.labels[i] == "floor")
    gap = np.abs(table.positions[:, :2] - flat.graph.positions[floor, :2])
    here = (gap < flat.graph.extents[floor, :2] / 2).all(axis=1)
    assert here[best(logs, 0.003)[0]].mean() > 0.9
    assert np.exp(logs[here]).mean() > np.exp(logs[~here]).mean()


def test_no_statement_rules_a_pose_out(flat, table):
    text = "next to the sofa, between the bed and the toilet, facing the stove, in the hall"
    said = read(text)
    logs = prior(said, flat, table)
    assert np.isfinite(logs).all()
    assert logs.min() > len(said.statements) * np.log(WRONG) - 1e-3
    one = prior(read("facing the stove"), flat, table)
    assert np.exp(one).mean(dtype=np.float64) == pytest.approx(1.0, abs=1e-3)


def test_what_is_unsure_says_less(flat, table):
    sure, unsure = (prior(read(t), flat, table) for t in ("by the bed", "maybe by the bed"))
    assert sure.max() > unsure.max() > 0 > unsure.min() > sure.min()


def test_not_and_far(flat, table):
    near, far = (prior(read(f"{t} the sofa"), flat, table) for t in ("next to", "far from"))
    close = near[:, 0] > 1.0
    assert (far[close] < 0).all()
    unseen = prior(read("I cannot see the sofa"), flat, table)
    seen = prior(read("I see the sofa"), flat, table)
    assert (unseen[seen > 1.0] < 0).all()


def test_kin_and_one_of_several(flat, table):
    assert np.array_equal(
        *(prior(read(f"by the {t}"), flat, table) for t in ("picture", "pictures"))
    )
    couch, sofa = (prior(read(f"near the {t}"), flat, table) for t in ("couch", "sofa"))
    assert np.corrcoef(couch[:, 0], sofa[:, 0])[0, 1] > 0.99
    plants = prior(read("next to a plant"), flat, table)[:, 0] > 0.5
    assert {int(away_ < 2.0) for away_ in away(flat, "plant", table.positions[plants])} == {1}
    assert (
        plants.sum()
        > (prior(read("next to the plant on the dresser"), flat, table)[:, 0] > 1).sum()
    )


def test_what_the_map_has_not_is_told(flat, table):
    said = read("next to the toaster, facing the piano on the sofa, in the gym")
    assert (prior(said, flat, table) == 0).all()
    reasons = [i.reason for i in find_unused(said, flat)]
    assert reasons == ["the map has no toaster", "the map has no gym"] or len(reasons) == 4
    assert not find_unused(read("next to the sofa"), flat)


def test_a_pose_is_told_why(flat, table):
    said = read("next to the sofa, facing the toaster")
    at = table.positions[away(flat, "sofa", table.positions).argmin()]
    near, toaster = evidence(said, flat, table, [*at, 0.0])
    assert (near.verdict, toaster.verdict) == ("for", "silent")
    assert [o.label for o in near.objects] == ["sofa"]
    assert toaster.note == "the map has no toaster"
    far = table.positions[away(flat, "sofa", table.positions).argmax()]
    assert evidence(said, flat, table, [*far, 0.0])[0].verdict == "against"


def test_a_table_without_positions(flat, table):
    panoramas = Panoramas(*(a[:0] for a in table.panoramas))
    none = replace(table, positions=table.positions[:0], panoramas=panoramas)
    assert prior(read("by the sofa"), flat, none).shape == (0, AZIMUTHS)
    assert evidence(read("by the sofa"), flat, none, [0, 0, 0, 0]) == ()


def test_compiled_code_does_as_plain_code():
    rng = np.random.default_rng(3)
    objects = rng.integers(0, 6, (4, ELEVATIONS, AZIMUTHS)).astype(np.uint16)
    ranges = rng.integers(0, 256, objects.shape).astype(np.uint8)
    slot = np.array([0, -1, 1, -1, -1, -1], np.int32)
    level = np.tile(decode_ranges(np.arange(256, dtype=np.uint8)), (ELEVATIONS, 1))
    near, at, cut = look_for(objects, ranges, slot, level, 2)
    weight, room = rng.uniform(size=6).astype(np.float32), np.array([0, 0, 1, -1, 1, -1], np.int32)
    profile = look_around_for(objects, ranges, weight, 1 / (1 + level))
    votes = vote_rooms(objects, ranges, room, np.exp(-level[0]), 2)
    distance = decode_ranges(ranges)
    for k in range(4):
        for j, o in enumerate((0, 2)):
            mine = np.where(objects[k] == o, distance[k], np.inf)
            assert near[j, k] == mine.min()
            assert mine[:, at[j, k]].min() == mine.min()
            assert cut[j, k] == (objects[k, 0] == o).any()
        assert np.allclose(profile[k], (weight[objects[k]] / (1 + distance[k])).max(axis=0))
        w = np.exp(-distance[k])
        shares = [w[room[objects[k]] == r].sum() for r in (0, 1)]
        assert np.allclose(votes[k], np.array(shares) / sum(shares), atol=1e-4)
    window = np.array([0.2, 0.7, 1.0, 0.5, 0.1], np.float32)
    found = dilate_profile(profile, 10, window)
    a = np.arange(AZIMUTHS)
    slow = [window[2 + o] * profile[:, (a + 10 + o) % AZIMUTHS] for o in range(-2, 3)]
    assert np.allclose(found, np.max(slow, axis=0))
