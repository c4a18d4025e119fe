"""Names of relations, and things found by them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.graph import SceneGraph
from placegraph.indoor.map.relations import RELATIONS
from placegraph.indoor.map.relations.words import (
    CANONICAL,
    canonical,
    find,
    matches,
    readings,
    same_thing,
)

SUBSET = (
    "supported by|left|right|front|behind|close by|inside|bigger than|smaller than|higher than|"
    "lower than|same symmetry as|same as|attached to|standing on|lying on|hanging on|connected to|"
    "leaning against|part of|belonging to|build in|standing in|cover|lying in|hanging in"
)


def graph(*edges):
    """Scene graph of edges "sofa 1 | next to | plant"."""
    rows = [tuple(part.strip() for part in edge.split("|")) for edge in edges]
    ids = list(dict.fromkeys(end for a, _, b in rows for end in (a, b)))
    return SceneGraph(
        ids=ids,
        labels=[id_.rstrip("0123456789 ") for id_ in ids],
        positions=np.zeros((len(ids), 3)),
        sources=[ids.index(a) for a, _, _ in rows],
        targets=[ids.index(b) for _, _, b in rows],
        relations=[relation for _, relation, _ in rows],
    )


def found(scene, *asked):
    return {f"{scene.ids[a]}, {scene.ids[b]}" for a, b in find(scene, *asked).tolist()}


def test_all_names_of_3dssg_and_ours_are_known():
    assert set(SUBSET.split("|")) | set(RELATIONS) == set(CANONICAL)


@pytest.mark.parametrize("relation", [*CANONICAL, "same material", "taped to"])
def test_every_name_means_itself(relation):
    assert matches(relation, relation)
    assert matches(relation.upper().replace(" ", "_"), relation.replace(" ", "-"))


@pytest.mark.parametrize(
    ("asked", "relations"),
    [
        ("next to", "next to|close by|leaning against|beside"),
        ("is right next to", "next to|close by|leaning against"),
        ("near", "next to|close by"),
        ("on", "standing on|lying on|supported by|attached to|hanging on|cover"),
        ("on the top of", "standing on|lying on"),
        ("lying on", "standing on|lying on|supported by"),
        ("in", "inside|standing in|lying in|hanging in"),
        ("mounted on", "attached to|hanging on|build in|part of"),
        ("above", "above|over"),
        ("to the left of", "left|left of"),
        ("to the right of", "right|right of"),
        ("in front of", "front"),
        ("in the same room as", "same room"),
    ],
)
def test_what_is_asked_for_matches(asked, relations):
    for relation in relations.split("|"):
        assert matches(asked, relation), relation


@pytest.mark.parametrize(
    ("asked", "relation"),
    [("under", "above"), ("left of", "right"), ("inside", "standing on"), ("on", "above"),
     ("next to", "same room"), ("near", "left"), ("standing on", "attached to"),
     ("above", "higher than"), ("in", "in the same room as"), ("right of", "front")],
)  # fmt: skip
def test_what_it_does_not(asked, relation):
    assert not matches(asked, relation)


def test_the_sofa_next_to_the_plant():
    """Whoever named the edge, and whichever way it points."""
    for relation in ("next to", "close by", "beside"):
        scene = graph(f"sofa 1 | {relation} | plant", "sofa 2 | next to | lamp")
        for asked in ("next to", "beside", "near the", "close by"):
            assert found(scene, "sofa", "next to", "plant") == {"sofa 1, plant"}, asked
            assert found(scene, "plant", asked, "sofa") == {"plant, sofa 1"}


def test_under_turns_the_edge():
    scene = graph(
        "lamp | above | desk",
        "cup | standing on | table",
        "rug | under | bed",
        "box | right | shelf",
    )
    assert found(scene, "desk", "under", "lamp") == {"desk, lamp"}
    assert found(scene, "table", "underneath", "cup") == {"table, cup"}
    assert found(scene, "bed", "above", "rug") == {"bed, rug"}
    assert found(scene, "shelf", "left of", "box") == {"shelf, box"}
    assert found(scene, "lamp", "under", "desk") == set()
    assert found(scene, "", "under", "") == {"desk, lamp", "table, cup", "rug, bed"}


def test_same_room_goes_on_from_one_to_the_next():
    scene = graph(
        "sofa 1 | same room | plant", "plant | same room | lamp", "bed | same room | lamp 2",
        "lamp 2 | next to | lamp",
    )  # fmt: skip
    assert found(scene, "sofa", "in the same room as", "lamp") == {"sofa 1, lamp"}
    assert found(scene, "lamp", "same room", "lamp") == set()
    assert found(scene, "bed", "same room", "") == {"bed, lamp 2"}


def test_nothing_is_found_of_nothing():
    scene = graph("sofa | next to | plant")
    assert find(scene, "sofa", "next to", "unicorn").shape == (0, 2)
    assert find(scene, "sofa", "orbiting", "plant").shape == (0, 2)
    assert find(scene.subgraph([]), "", "on", "").shape == (0, 2)


@pytest.mark.parametrize(
    ("asked", "label", "fits"),
    [("chair", "DeskChair", True), ("chairs", "desk chair", True), ("Desk chairs", "chair", True),
     ("desk chair", "kitchen_chair", False), ("shelves", "shelf", True), ("stove", "stoves", True),
     ("boxes", "box", True), ("glass", "glasses", True), ("knives", "knife", True),
     ("lamp", "lampshade", False), ("coffee table", "table", True), ("table", "table lamp", False),
     ("", "anything", True), ("sofa", "", False), ("berry", "berries", True)],
)  # fmt: skip
def test_labels(asked, label, fits):
    assert same_thing(asked, label) is fits


@given(st.text(max_size=30), st.sampled_from(sorted(CANONICAL)))
def test_any_text_has_a_reading(asked, relation):
    assert readings(asked)
    assert matches(asked, asked)
    name, turned = canonical(relation)
    assert canonical(name) == (name, False)
    assert canonical(relation) in readings(relation)
    assert not turned or (name, not turned) not in readings(relation)


@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.sampled_from(sorted(CANONICAL)), st.integers(0, 5)),
        max_size=12,
    ),
    st.sampled_from(["on", "next to", "under", "in", "right of", "same room", "larger than"]),
)
def test_what_is_found_is_said_by_an_edge(edges, asked):
    scene = SceneGraph(
        ids=list("abcdef"), labels=["thing"] * 6, positions=np.zeros((6, 3)),
        sources=np.array([a for a, _, _ in edges], int),
        relations=[r for _, r, _ in edges],
        targets=np.array([b for _, _, b in edges], int),
    )  # fmt: skip
    rows = find(scene, "thing", asked, "")
    assert len(np.unique(rows, axis=0)) == len(rows)
    said = {(a, b) for a, r, b in edges if matches(asked, r)}
    pairs = set(map(tuple, rows.tolist()))
    assert said <= pairs
    if asked in {"next to", "same room"}:
        assert {(b, a) for a, b in pairs} == pairs
