"""The status: what makes it worse, what never does, and what it says."""

import ast
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import placegraph
from placegraph.core.estimate import PoseEstimate, PoseMode, Status
from placegraph.indoor.pose.agreement import CONFIDENCE, Agreement
from placegraph.indoor.status import SURE, Diagnostics, decide_fit, decide_joined, decide_pose

INDOOR = Path(placegraph.__file__).parent / "indoor"

ORDER = [Status.LOST, Status.AMBIGUOUS, Status.OK]
GOOD = Agreement(1.0, 0.95, 0.97, 0.2, np.full(8, 5.0), np.full(8, 4.0), constraint=0.1)
TOLD = 60.0


def modes(*shares, spread=0.05):
    """Modes of these probabilities, known to `spread` [m] along each axis."""
    covariance = np.diag([spread**2, spread**2, 0.01, 1e-4, 1e-4, 0.01])
    return [
        PoseMode(np.eye(4), np.zeros(4), covariance, share, "flat", np.eye(4)) for share in shares
    ]


def test_all_agrees():
    answer, reason = decide_fit(GOOD, modes(0.99, 0.01), TOLD)
    assert answer is Status.OK
    assert reason == (
        "One place holds 99% of the probability within 25 cm: 95% of the labelled patches, "
        "97% of the depth readings, the colours agree with the map."
    )


@pytest.mark.parametrize(
    "cue",
    [
        {"depth": math.nan, "colour": math.nan}, {"semantic": math.nan, "colour": math.nan},
        {"semantic": math.nan}, {"colour": math.nan}, {"depth": math.nan},
        {"semantic": math.nan, "depth": math.nan},
    ],
)  # fmt: skip
def test_fewer_cues_can_be_enough(cue):
    agreed = replace(GOOD, **cue)
    assert decide_fit(agreed, modes(1.0), TOLD)[0] is Status.OK
    names = ("semantic", "depth", "colour")
    worst = {name: 0.0 for name in names if not math.isnan(getattr(agreed, name))}
    assert decide_fit(replace(agreed, **worst), modes(1.0), 0.0)[0] is not Status.OK


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"covered": 0.05}, "map shows only 5%"),
        ({"semantic": 0.1}, "only 10% of the labelled patches"),
        ({"depth": 0.05}, "only 5% of the depth readings"),
        ({"semantic": math.nan, "depth": math.nan, "colour": 0.0}, "colours"),
        ({"semantic": math.nan, "depth": math.nan, "colour": math.nan}, ""),
    ],
)
def test_what_cannot_be_is_lost(change, says):
    answer, reason = decide_fit(replace(GOOD, **change), modes(1.0), TOLD)
    assert answer is Status.LOST
    assert reason.startswith("No place on the map fits")
    assert says in reason


def test_a_wall_and_a_floor_are_no_place():
    few = np.where(np.arange(8) < 2, 5.0, 0.0)
    agreed = replace(GOOD, depth=math.nan, colour=math.nan, weights=few)
    answer, reason = decide_fit(agreed, modes(1.0), TOLD)
    assert answer is Status.AMBIGUOUS
    assert "only 2" in reason
    assert decide_fit(replace(agreed, colour=0.5), modes(1.0), TOLD)[0] is Status.OK


def test_rivals_make_it_ambiguous():
    answer, reason = decide_fit(GOOD, modes(0.55, 0.45), TOLD)
    assert answer is Status.AMBIGUOUS
    assert reason == (
        "The first of 2 places holds 55% of the probability within 25 cm; others fit as well."
    )
    _, reason = decide_fit(GOOD, modes(0.4, 0.3, 0.295, 0.005), TOLD)
    assert "The first of 3 places holds 40%" in reason


def test_other_images_of_the_room_exclude_rivals_or_the_best_mode():
    found = Diagnostics(agreement=replace(GOOD, frames=np.array([[0.95, 0.97, 0.2]])))
    status, reason, found = decide_pose(found, modes(0.6, 0.4))
    alone = PoseEstimate(status, tuple(modes(0.6, 0.4)), f"{reason} Note.", diagnostics=found)
    assert status is Status.AMBIGUOUS
    assert decide_joined(alone, [0.995, 0.005]).status is Status.OK
    half = decide_joined(alone, [0.7, 0.3])
    assert (half.status, half.best.probability) == (status, 0.7)
    assert half.reason == reason.replace("60%", "70%") + " Note."
    other = decide_joined(alone, [0.3, 0.7])
    assert [m.probability for m in other.modes] == [
        0.7,
        0.3,
    ]  # best first, and the reason speaks of it
    assert "first of 2 places holds 70% of" in other.reason
    sure = replace(alone, status=Status.OK)
    assert decide_joined(sure, [0.9, 0.1]).status is Status.OK
    assert decide_joined(sure, [0.4, 0.6]).status is Status.AMBIGUOUS


@pytest.mark.parametrize(("searched", "why"), [(0.9, "may look the same"), (-0.9, "much less")])
def test_reasons_against_a_pose_by_what_was_not_searched(searched, why):
    agreed = replace(GOOD, frames=np.array([[0.95, 0.97, 0.2]]))
    status, reason, _ = decide_pose(Diagnostics(agreement=agreed, searched=searched), modes(1.0))
    assert status is Status.AMBIGUOUS
    assert why in reason


def test_a_place_known_to_a_metre_only_is_not_ok():
    answer, reason = decide_fit(GOOD, modes(1.0, spread=1.0), TOLD)
    assert answer is Status.AMBIGUOUS
    assert reason == (
        "One place holds 100% of the probability within 2.5 m; a certain pose needs 50 cm."
    )
    (best,) = modes(1.0)
    best.covariance[2, 2] = 0.3**2
    answer, reason = decide_fit(GOOD, [best], TOLD)
    assert answer is Status.AMBIGUOUS
    assert "within 75 cm, above all in height; a certain pose needs 50 cm" in reason


shares = st.floats(0, 1)
told_weights = st.sampled_from([np.zeros(8), np.full(8, 3.0)])
maybe = st.one_of(st.just(math.nan), shares)


@given(
    st.builds(
        Agreement, shares, maybe, maybe, maybe, told_weights, st.just(np.zeros(8)), tone=maybe
    ),
    st.floats(0.01, 1), st.floats(0, 100), st.floats(0.01, 1),
    st.sampled_from(
        ["covered", "semantic", "depth", "colour", "tone", "probability", "told", "spread"]
    ),
    shares,
)  # fmt: skip
def test_better_agreement_never_makes_it_worse(agreed, probability, told, spread, what, more):
    before, reason = decide_fit(agreed, modes(probability, 1 - probability, spread=spread), told)
    assert reason.split(".")[0]
    assert reason.endswith(".")
    assert "nan" not in reason
    if what == "probability":
        probability += more * (1 - probability)
    elif what == "told":
        told += 100 * more
    elif what == "spread":
        spread *= 1 - 0.9 * more
    else:
        value = getattr(agreed, what)
        agreed = replace(agreed, **{what: value + more * (1 - value)})
    after = decide_fit(agreed, modes(probability, 1 - probability, spread=spread), told)[0]
    assert ORDER.index(after) >= ORDER.index(before)


@pytest.mark.parametrize(
    ("colour", "status"), [(0.004, "LOST"), (0.018, "AMBIGUOUS"), (0.03, "AMBIGUOUS"), (0.05, "OK")]
)
def test_images_alone_must_be_clear(colour, status):
    agreed = replace(GOOD, semantic=math.nan, depth=math.nan, colour=colour)
    assert decide_fit(agreed, modes(1.0), TOLD)[0].value == status


@pytest.mark.parametrize("weights", [np.zeros(8), np.r_[5.0, np.zeros(7)]])
def test_a_bare_wall_has_no_cliff(weights):
    bare = replace(GOOD, constraint=0.0, weights=weights)
    odds = [CONFIDENCE.odds(replace(bare, colour=c)) for c in np.linspace(0.0, 0.12, 121)]
    steps = np.diff(odds)
    assert steps.min() > 0
    assert steps.max() < 1.0
    assert CONFIDENCE.probability(replace(bare, colour=0.0), 1.0) < SURE


def test_tones_tell_a_place_whose_depth_has_changed():
    """The office's other half: chairs moved, steps of colour blurred, and the right pose was `LOST`."""
    moved = replace(GOOD, semantic=math.nan, depth=0.7, colour=0.015, constraint=0.19)
    assert decide_fit(replace(moved, tone=0.05), modes(1.0), TOLD)[0] is not Status.OK
    assert decide_fit(replace(moved, tone=0.35), modes(1.0), TOLD)[0] is Status.OK
    # a wall and a floor of a wrong room, seen from low above the ground
    floor = replace(moved, depth=0.72, colour=0.009, tone=0.33, constraint=0.06)
    assert decide_fit(floor, modes(1.0), TOLD)[0] is not Status.OK
    denied = replace(GOOD, semantic=math.nan, depth=0.3, tone=1.0)
    assert decide_fit(denied, modes(1.0), TOLD)[0] is Status.LOST


def test_only_one_file_sets_a_status():
    """Other indoor files compare statuses, and read no public numbers to decide."""
    for path in INDOOR.rglob("*.py"):
        if path == INDOOR / "status.py" or "Status." not in (text := path.read_text()):
            continue
        nodes = list(ast.walk(ast.parse(text)))
        compares = [node for node in nodes if isinstance(node, ast.Compare)]
        compared = {id(part) for node in compares for part in ast.walk(node)}
        for node in nodes:
            if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "Status":
                assert id(node) in compared, f"{path.name}:{node.lineno} sets {node.attr}"
    keys = re.compile(r"\[\"(trust|rival|undecided|fits)\"\]")
    assert [
        p for p in INDOOR.rglob("*.py") if p.name != "status.py" and keys.search(p.read_text())
    ] == []
