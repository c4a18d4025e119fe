"""What an answer claims, when it is sure, and what forbids that."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.estimate import Status
from placegraph.outdoor.language import describe
from placegraph.outdoor.search.confidence import (
    AT_A_PLACE,
    HERE,
    IN_SIGHT,
    Doubt,
    believed,
    claim_of,
    status_of,
)
from placegraph.outdoor.search.posterior import Posterior, modes

SPACING = 6.67
FAR = 5000.0


def found_of(*peaks, elsewhere=0.0):
    """Posterior of (east [m], probability)."""
    east = np.array([(x, 0.0) for x, _ in peaks]).reshape(-1, 2)
    return Posterior(east, np.array([p for _, p in peaks]), elsewhere)


def judged(found, claim=IN_SIGHT, doubt=None):
    return status_of(found, modes(found, 5, SPACING), claim, doubt)


@pytest.mark.parametrize("claim", [IN_SIGHT, AT_A_PLACE])
def test_status(claim):
    assert judged(found_of((0, 0.999)), claim)[0] is Status.OK
    assert judged(found_of((0, 0.6), (FAR, 0.4)), claim)[0] is Status.AMBIGUOUS
    assert judged(found_of((0, 0.01)), claim)[0] is Status.AMBIGUOUS
    assert judged(found_of((0, 0.4), elsewhere=0.6), claim)[0] is Status.LOST
    assert judged(found_of(elsewhere=0.1), claim)[0] is Status.LOST


def test_a_block_is_enough_for_who_tells_the_way_but_a_small_map_is_not():
    near = found_of((0, 0.6), (150, 0.395))
    assert judged(near)[0] is Status.AMBIGUOUS
    status, reason = judged(near, AT_A_PLACE)
    assert status is Status.OK
    assert "within 250 m" in reason
    scattered = found_of(*((60.0 * i, 0.24) for i in range(4)))
    assert judged(scattered, AT_A_PLACE)[0] is Status.AMBIGUOUS, f"the best holds less than {HERE}"


def test_a_name_that_is_not_on_the_map_forbids_to_be_sure():
    doubt = Doubt(("King Street West",), ("flurble",))
    status, reason = judged(found_of((0, 0.9999)), doubt=doubt)
    assert status is Status.AMBIGUOUS
    assert reason.startswith("“King Street West” is not on this map, so the place cannot be sure.")
    assert "Not understood: “flurble”." in reason
    two = judged(found_of((0, 0.9999)), doubt=Doubt(("A", "B")))[1]
    assert two.startswith("“A” and “B” are not")


@given(st.floats(0.0, 1.0), st.sampled_from([IN_SIGHT, AT_A_PLACE]), st.booleans())
def test_trust_takes_and_never_gives(share, claim, unknown):
    for trust in (claim.whole, claim.near):
        assert 0.0 <= trust.of(share, unknown=unknown) <= share
        assert trust.of(share, unknown=True) <= trust.of(share, unknown=False)
        assert trust.of(0.5 * share, unknown=unknown) <= trust.of(share, unknown=unknown)


def test_what_is_not_believed_lies_elsewhere():
    found = found_of((0, 0.7), (FAR, 0.2), elsewhere=0.1)
    peaks = modes(found, 5, SPACING)
    posterior, shrunk = believed(found, peaks, AT_A_PLACE)
    assert shrunk[0].probability == AT_A_PLACE.near.of(0.7, unknown=False) < 0.7
    assert shrunk[1].probability / shrunk[0].probability == pytest.approx(2 / 7)
    assert posterior.probabilities.sum() + posterior.elsewhere == pytest.approx(1.0)
    nothing = found_of(elsewhere=1.0)
    assert believed(nothing, [], IN_SIGHT) == (nothing, [])


@pytest.mark.parametrize(
    ("text", "claim"),
    [
        ("A bench is north of me. The church is east of the bench.", IN_SIGHT),
        ("There is a bakery to my left and a bank near me.", IN_SIGHT),
        ("I'm at the bakery.", AT_A_PLACE),
        ("Meet me northeast of you, by the church.", AT_A_PLACE),
    ],
)
def test_what_is_claimed(text, claim):
    assert claim_of(describe(text)) is claim


CLEAR = "I am on Speicherweg. The museum is south of me."


@pytest.mark.parametrize(
    "more",
    [
        "",
        " I am on King Street West.",
        " Xyzal Motors is next to me.",
        " The Golden Dragon Restaurant is west.",
    ],
)
def test_what_the_map_lacks_is_named(harbour, more):
    estimate = harbour.locate(CLEAR + more)
    assert (estimate.status is Status.OK) == (not more)
    assert ("not on this map" in estimate.reason) == bool(more)


BARE = """
[town]
name = Bare
center = 8.0 50.0
metres = 10

[drawing]
.....................
.A.................B.
.....................

[legend]
A: amenity=bank name=Rexbank
B: shop=bakery name=Kern
"""


@pytest.mark.parametrize("name", ["King Street West", "Xyzal Motors"])
def test_it_is_no_wonder_that_a_list_of_landmarks_lacks_a_name(make_city, name):
    estimate = make_city(BARE).locate(f"I am at {name}, next to the Rexbank.")
    assert "not on this map" not in estimate.reason
