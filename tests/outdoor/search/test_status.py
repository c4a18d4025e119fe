import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.estimate import Status
from placegraph.outdoor.language import describe
from placegraph.outdoor.search.posterior import Posterior, find_modes
from placegraph.outdoor.search.status import (
    AT_A_PLACE,
    IN_SIGHT,
    Diagnostics,
    decide,
    diagnose,
    infer_claim,
    shrink,
)

SPACING = 6.67
FAR = 5000.0
NO_NAME = "“King Street West” is not on this map, so the place cannot be sure."


def make_posterior(*peaks, elsewhere=0.0):
    """Posterior of (east [m], probability)."""
    east = np.array([(x, 0.0) for x, _ in peaks]).reshape(-1, 2)
    return Posterior(east, np.array([p for _, p in peaks]), elsewhere)


def judge(found, claim=IN_SIGHT):
    return decide(diagnose(found, find_modes(found, 5, SPACING), claim, None))


@pytest.mark.parametrize("claim", [IN_SIGHT, AT_A_PLACE])
def test_status(claim):
    assert judge(make_posterior((0, 0.999)), claim)[0] is Status.OK
    assert judge(make_posterior((0, 0.6), (FAR, 0.4)), claim)[0] is Status.AMBIGUOUS
    assert judge(make_posterior((0, 0.01)), claim)[0] is Status.AMBIGUOUS
    assert judge(make_posterior((0, 0.4), elsewhere=0.6), claim)[0] is Status.LOST
    assert judge(make_posterior(elsewhere=0.1), claim)[0] is Status.LOST


def test_a_block_is_enough_for_who_tells_the_way_but_a_small_map_is_not():
    near = make_posterior((0, 0.6), (150, 0.395))
    assert judge(near)[0] is Status.AMBIGUOUS
    status, reason = judge(near, AT_A_PLACE)
    assert status is Status.OK
    assert "within 250 m, where 2 places fit: it may be any of them" in reason
    peaks = find_modes(near, 5, SPACING)
    _, (best, _) = shrink(near, peaks, diagnose(near, peaks, AT_A_PLACE, None))
    assert reason.endswith(f"Within 50 m it holds {best.probability:.0%}.")
    assert "2 places" not in judge(make_posterior((0, 0.999), (150, 0.0005)), AT_A_PLACE)[1]
    scattered = make_posterior(*((60.0 * i, 0.24) for i in range(4)))
    assert judge(scattered, AT_A_PLACE)[0] is Status.AMBIGUOUS, (
        f"the best holds less than {AT_A_PLACE.min_best}"
    )


@pytest.mark.parametrize(
    ("findings", "status", "reason"),
    [
        ({}, Status.OK, "One place holds 100% of the probability within 50 m."),
        ({"unknown_names": ("King Street West",)}, Status.AMBIGUOUS, NO_NAME),
        ({"unknown_names": ("A", "B")}, Status.AMBIGUOUS, "“A” and “B” are not on this map, so"),
        ({"unknown_names": ("A",), "unread": ("flurble",)}, Status.AMBIGUOUS, "“flurble”."),
        ({"cell_matcher": "transformer"}, Status.AMBIGUOUS, "The transformer matcher only ranks"),
        ({"cell_matcher": "embedding", "is_ranking_only": True, "elsewhere": 0.6}, Status.AMBIGUOUS,
         "The embedding matcher only ranks"),
        ({"contradiction": "x"}, Status.LOST, "The description contradicts itself: x"),
        ({"obstacle": "Off the map."}, Status.LOST, "Off the map."),
        ({"remark": "The last text adds nothing."}, Status.OK, "The last text adds nothing."),
    ],
)  # fmt: skip
def test_each_finding_decides(findings, status, reason):
    found = decide(Diagnostics(**{"best": 0.9999, "near_best": 0.9999} | findings))
    assert found[0] is status
    assert reason in found[1]


@given(st.floats(0.0, 1.0), st.sampled_from([IN_SIGHT, AT_A_PLACE]), st.booleans())
def test_calibration_takes_and_never_gives(share, claim, unknown):
    for trust in (claim.of_radius, claim.of_place):
        assert 0.0 <= trust.apply(share, doubtful=unknown) <= share
        assert trust.apply(share, doubtful=True) <= trust.apply(share, doubtful=False)
        assert trust.apply(0.5 * share, doubtful=unknown) <= trust.apply(share, doubtful=unknown)


def test_what_is_not_believed_lies_elsewhere():
    found = make_posterior((0, 0.7), (FAR, 0.2), elsewhere=0.1)
    peaks = find_modes(found, 5, SPACING)
    posterior, shrunk = shrink(found, peaks, diagnose(found, peaks, AT_A_PLACE, None))
    assert shrunk[0].probability == AT_A_PLACE.of_place.apply(0.7, doubtful=False) < 0.7
    assert shrunk[1].probability / shrunk[0].probability == pytest.approx(2 / 7)
    assert posterior.probabilities.sum() + posterior.elsewhere == pytest.approx(1.0)
    nothing = make_posterior(elsewhere=1.0)
    assert shrink(nothing, [], diagnose(nothing, [], IN_SIGHT, None)) == (nothing, [])


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
    assert infer_claim(describe(text)) is claim


CLEAR = "I am on Speicherweg. The museum is south of me."


MORE = (
    "",
    "I am on King Street West.",
    "Xyzal Motors is next to me.",
    "The Golden Dragon is west.",
)


@pytest.mark.parametrize("more", MORE)
def test_what_the_map_lacks_is_named(harbour, more):
    estimate = harbour.locate(f"{CLEAR} {more}")
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


def test_one_shape_of_road_does_not_tell_two_petrol_stations_apart(build_world):
    """Maps draw few roundabouts: the other station may have one, too."""
    kinds = {"shop": "clothes"}, {"amenity": "bench"}
    town = [(60.0 * i, 60.0 * j, kinds[(i + j) % 3 == 0]) for i in range(30) for j in range(30)]
    stations = [(east, 130.0, {"amenity": "fuel"}) for east in (130.0, 580.0)]
    city = build_world([*town, *stations, (600.0, 150.0, {"highway": "mini_roundabout"})])
    estimate = city.locate("I'm at a petrol station. There is a roundabout.")
    assert estimate.status is Status.AMBIGUOUS
    assert estimate.evidence[1].weight < 3.0


@pytest.mark.parametrize("name", ["King Street West", "Xyzal Motors"])
def test_it_is_no_wonder_that_a_list_of_landmarks_lacks_a_name(make_city, name):
    estimate = make_city(BARE).locate(f"I am at {name}, next to the Rexbank.")
    assert "not on this map" not in estimate.reason


@pytest.mark.parametrize(
    "text",
    [
        "43.7384, 7.4246", "I am at 43.7384 7.4246", "https://maps.google.com/?q=43.7384,7.4246",
        "https://www.openstreetmap.org/#map=18/43.7384/7.4246", "geo:43.7384,7.4246", "43.7384° N, 7.4246° E",
        "https://www.google.com/maps/place/Casino/@43.7384,7.4246,17z",
    ],
)  # fmt: skip
def test_coordinates_are_no_description_but_a_hint(text, harbour):
    estimate = harbour.locate(text)
    assert estimate.status is Status.LOST
    assert "pass them as `near` (--near 7.4246,43.7384 on the command line)" in estimate.reason


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("49.28274, -123.12079", "-123.12079,49.28274"),
        ("-123.12079, 49.28274", "-123.12079,49.28274"),
        ("33.86881 S, 151.20930 E", "151.2093,-33.86881"),
        ("-33.86881° S, 151.20930° E", "151.2093,-33.86881"),
    ],
)
def test_coordinates_keep_digits_and_signs(text, near, harbour):
    assert f"(--near {near} on" in harbour.locate(text, language="en").reason
