import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.outdoor.test_locate import HARBOUR, metres, sound

from placegraph.core.estimate import Status
from placegraph.errors import DescriptionError, OptionError
from placegraph.outdoor.language import describe
from placegraph.outdoor.search.ask import NO, UNKNOWN, YES
from placegraph.outdoor.track.tracker import CityTracker

BENCH, FOUNTAIN = {"amenity": "bench"}, {"amenity": "fountain"}
TEXT = "A fountain is north of me, and a bench is south of me."


LAST = "There is a {} north of me, and a kiosk to the south."
TREES = [(-24, 4), (-22, -6), (22, 5), (25, -3), (4, 24), (-5, -25)]


@pytest.fixture
def twins(build_world):
    """Two corners alike 600 m apart; 120 m east of each a kiosk, and a bakery or a pharmacy."""
    things = []
    for east, shop in ((0, {"shop": "bakery"}), (600, {"amenity": "pharmacy"})):
        things += [(east, 15, FOUNTAIN), (east, -15, BENCH), (east + 120, 15, shop)]
        things += [(east + 120, -15, {"shop": "kiosk"})]
        for x in (east, east + 60, east + 120, east + 180):
            things += [(x + dx, dy, {"natural": "tree"}) for dx, dy in TREES]
    return build_world(things)


def place_of(city, estimate):
    return city.plane.to_plane((estimate.best.longitude, estimate.best.latitude))


def off(city, estimate, at, east_north):
    return float(np.hypot(*(place_of(city, estimate) - at(city, east_north))))


def test_answers_are_read_with_what_was_said_here(twins):
    tracker = CityTracker(twins)
    tracker.walk(10.0)
    first = tracker.tell("A kiosk is south of me.")
    question = first.next_question(twins)
    assert question.options == (YES, NO)
    shop = question.subjects[0].label
    assert shop in {"shop=bakery", "amenity=pharmacy"}
    unknown = tracker.answer(question.answer(UNKNOWN))
    assert [m.probability for m in unknown.modes] == [m.probability for m in first.modes]
    again = unknown.next_question(twins)
    assert again.subjects[0].label != shop
    told = tracker.answer(again.answer(YES))
    assert told.status is Status.OK
    assert told.best.probability > 1.5 * first.best.probability
    assert len(told.understood.statements) == 2
    assert told.next_question(twins) is None


def test_a_second_sentence_tells_two_places_apart(twins, at):
    for shop, other, east in (("bakery", "pharmacy", 0.0), ("pharmacy", "bakery", 600.0)):
        tracker = CityTracker(twins)
        first = tracker.tell(TEXT)
        assert first.status is Status.AMBIGUOUS
        assert [m.probability for m in first.modes[:2]] == pytest.approx([0.4, 0.4], abs=0.1)
        between = tracker.tell("I walked about 120 m east.")
        assert between.status is Status.AMBIGUOUS
        last = tracker.tell(LAST.format(shop))
        sound(last, twins)
        assert last.status is Status.OK
        assert off(twins, last, at, (east + 120.0, 0.0)) < 25.0
        assert other not in " ".join(e.statement for e in last.evidence)
        assert [w.status.name for w in tracker.history] == ["AMBIGUOUS", "AMBIGUOUS", "OK"]
        assert tracker.history[-1].best is last.best
        alone = twins.locate(LAST.format(shop))
        assert last.best.probability > 0.9
        assert metres(twins, alone.best, (last.best.longitude, last.best.latitude)) < 40.0


@pytest.mark.parametrize(
    "go",
    [
        lambda t: t.move(120.0, 0.0),
        lambda t: t.walk(120.0, math.pi / 2),
        lambda t: t.walk(120.0),
        lambda t: t.tell("I went 60 metres north. Then I turned right and walked 120 m, and I"
                         " turned right again. I walked 60 m."),
    ],
)  # fmt: skip
def test_ways_to_go(go, twins, at):
    tracker = CityTracker(twins)
    tracker.tell(TEXT)
    go(tracker)
    last = tracker.tell(LAST.format("bakery"))
    assert last.status is Status.OK
    assert off(twins, last, at, (120.0, 0.0)) < 30.0


def test_one_text_may_hold_places_and_ways(twins, at):
    step, whole = CityTracker(twins), CityTracker(twins)
    texts = (TEXT, "I walked 120 m east.", LAST.format("bakery"))
    for text in texts:
        step.tell(text)
    whole.tell(" ".join(texts))
    assert len(whole.history) == 1
    assert whole.estimate.best.probability == pytest.approx(step.estimate.best.probability)
    assert off(twins, whole.estimate, at, (120.0, 0.0)) < 25.0


def test_measured_motion_is_sharper_than_told(twins):
    spread = []
    for go in (lambda t: t.move(120.0, 0.0), lambda t: t.tell("I walked 120 m east.")):
        tracker = CityTracker(twins, near=None)
        tracker.tell(TEXT)
        spread.append(np.trace(go(tracker).best.covariance))
    assert spread[0] < 0.7 * spread[1]


@pytest.mark.parametrize("text", [text for text, _, _ in HARBOUR])
def test_the_first_sentence_is_located(text, harbour):
    told, located = CityTracker(harbour).tell(text), harbour.locate(text)
    sound(told, harbour)
    assert told.status is not Status.LOST
    assert told.best.cell == located.best.cell
    # the sentence alone claims less than what a way is followed to
    assert told.best.probability > located.best.probability - 0.1
    assert metres(harbour, told.best, (located.best.longitude, located.best.latitude)) < 5.0


ONE, TWO = "I am next to a bench.", "A tram stop is south of me."


def test_sentences_without_motion_are_one_text(harbour):
    tracker = CityTracker(harbour)
    first = tracker.tell(ONE)
    again = tracker.tell(ONE)  # which adds nothing
    assert [m.probability for m in again.modes] == [m.probability for m in first.modes]
    last, located = tracker.tell(TWO), harbour.locate(f"{ONE} {TWO}", matcher="relational")
    assert metres(harbour, last.best, (located.best.longitude, located.best.latitude)) < 5.0
    assert last.best.probability == pytest.approx(located.best.probability, abs=0.05)


SENTENCES = [ONE, TWO, "There is a church to the north.", "I am on Lange Straße.",
             "A fountain is east of me.", "There are no trees here."]  # fmt: skip


@settings(max_examples=12)
@given(st.permutations(SENTENCES).map(lambda s: s[:2]))
def test_the_order_of_sentences_does_not_matter(harbour, pair):
    one, two = CityTracker(harbour), CityTracker(harbour)
    for text, other in zip(pair, reversed(pair), strict=True):
        a, b = one.tell(text), two.tell(other)
    assert [m.cell for m in a.modes] == [m.cell for m in b.modes]
    for mode, same in zip(a.modes, b.modes, strict=True):
        assert mode.probability == pytest.approx(same.probability, abs=1e-4)


def test_what_is_absent_counts(harbour):
    tracker = CityTracker(harbour)
    before = tracker.tell("I am next to a bench.").best
    after = tracker.tell("There are no trees here.")
    assert after.best.cell != before.cell or after.best.probability != before.probability
    only = CityTracker(harbour).tell("There are no trees here.")
    assert only.status is Status.AMBIGUOUS
    assert only.best.probability < 0.2


def test_a_description_ready_made(harbour):
    tracker = CityTracker(harbour)
    first = tracker.tell(describe(HARBOUR[0][0], names=harbour.name_index))
    assert first.best.cell == harbour.locate(HARBOUR[0][0]).best.cell
    assert tracker.tell("There is a fountain west of me.").status is Status.OK


def test_over_the_border_and_back(harbour):
    text, _, _ = HARBOUR[0]
    tracker = CityTracker(harbour)
    start = tracker.tell(text).best
    there = place_of(harbour, tracker.estimate)
    south = float(there[1] - harbour.views.positions[:, 1].min()) + 150.0
    tracker.move(0.0, -south)
    assert tracker.elsewhere < 0.5  # followed beyond what can be seen from viewpoints
    back = tracker.move(0.0, south)
    assert metres(harbour, back.best, (start.longitude, start.latitude)) < 25.0
    gone = tracker.move(0.0, -3000.0)
    assert tracker.elsewhere > 0.8
    assert gone.status is Status.LOST
    tracker.move(0.0, 3000.0)
    found = tracker.tell(HARBOUR[4][0])
    assert found.status is not Status.LOST
    assert found.best.cell == harbour.locate(HARBOUR[4][0]).best.cell


@pytest.mark.parametrize("way", [None, "I walked 20 m north."])
def test_a_kidnapped_speaker_is_found_again(way, harbour, hafenstadt):
    (text, row, column), (other, there_row, there_column) = HARBOUR[0], HARBOUR[9]
    tracker = CityTracker(harbour)
    assert metres(harbour, tracker.tell(text).best, hafenstadt.lonlat(row, column)) < 30.0
    if way:
        tracker.tell(way)
    found = tracker.tell(other)
    if found.status is not Status.OK:
        found = tracker.tell("A fence is south of me. There is no shop here.")
    truth = hafenstadt.lonlat(there_row + 0.5, there_column + 0.5)
    assert metres(harbour, found.best, truth) < 40.0


def test_a_long_way_leaves_nothing(harbour):
    tracker = CityTracker(harbour)
    tracker.tell(HARBOUR[0][0])
    far = tracker.tell("I drove 12 km north.")
    assert far.status is not Status.OK
    assert far.best.probability < 0.1
    assert tracker.heading == pytest.approx(0.0)
    assert tracker.tell(HARBOUR[4][0]).status is Status.OK


def test_nothing_understood_changes_nothing(harbour):
    tracker = CityTracker(harbour)
    assert tracker.estimate.status is Status.LOST
    for text in ("asdf qwer", "A zoo is north of me.", "🥐🥐🥐"):
        nothing = tracker.tell(text)
        assert (nothing.status, nothing.modes) == (Status.LOST, ())
        assert nothing.reason.endswith(".")
    known = tracker.tell(HARBOUR[0][0])
    for text in ("asdf qwer", "A zoo is north of me."):
        same = tracker.tell(text)
        assert same.best.probability == known.best.probability
        assert "last" in same.reason


def test_a_contradiction_is_lost(harbour):
    tracker = CityTracker(harbour)
    tracker.tell("I'm on Speicherweg. The museum is south of me.")
    estimate = tracker.tell("The museum is north of me.")
    assert estimate.status is Status.LOST
    assert "contradicts itself" in estimate.reason


def test_the_way_tells_left_from_right(twins, at):
    tracker = CityTracker(twins)
    tracker.tell(TEXT)
    tracker.tell("I walked 120 m east.")
    assert tracker.heading == pytest.approx(math.pi / 2)
    left = tracker.tell("There is a bakery on my left.")
    assert [e.verdict for e in left.evidence if "bakery" in e.statement] == ["for"]
    assert off(twins, left, at, (120.0, 0.0)) < 25.0
    tracker.tell("I turned right.")
    assert tracker.heading == pytest.approx(math.pi)
    assert CityTracker(twins, heading=1.0).heading == 1.0
    tracker.walk(10.0)
    assert tracker.heading is None


def test_evidence_of_before_is_remembered(twins):
    tracker = CityTracker(twins)
    tracker.tell(TEXT)
    tracker.move(120.0, 0.0)
    last = tracker.tell(LAST.format("bakery"))
    assert [e.verdict for e in last.evidence] == ["for"] * 4
    assert not any(e.note for e in last.evidence[:2])
    assert all("m before" in e.note for e in last.evidence[2:])
    assert {o.label for e in last.evidence[2:] for o in e.objects} == {
        "amenity=fountain", "amenity=bench"
    }  # fmt: skip


def test_reset_forgets(harbour):
    tracker = CityTracker(harbour)
    fresh = [tracker.tell(text) for text in (ONE, "I walked 50 m north.", TWO)]
    lost = tracker.reset()
    assert (lost.status, tracker.history, tracker.heading) == (Status.LOST, (), None)
    again = [tracker.tell(text) for text in (ONE, "I walked 50 m north.", TWO)]
    for a, b in zip(fresh, again, strict=True):
        assert json.dumps(a.to_dict()) == json.dumps(b.to_dict())
        np.testing.assert_array_equal(a.support, b.support)


def test_near_is_where_it_starts(twins, at):
    for east in (0.0, 600.0):
        near = twins.plane.to_lonlat(at(twins, (east, 0.0)))
        tracker = CityTracker(twins, near=(*near, 100.0))
        assert tracker.move(0.0, 0.0).best is not None
        first = tracker.tell(TEXT)
        assert first.status is Status.OK
        assert off(twins, first, at, (east, 0.0)) < 25.0
    away = CityTracker(twins, near=(0.0, 0.0))
    assert away.move(1.0, 0.0).status is Status.LOST
    assert away.elsewhere > 0.5


BAD = [float("nan"), float("inf"), "ten", None, (1, 2), object, True]


@pytest.mark.parametrize("text", ["", "  \n", "\0", "x" * 30_000, None, 5, b"bench", ["bench"]])
def test_no_text(text, harbour):
    tracker = CityTracker(harbour)
    with pytest.raises(DescriptionError):
        tracker.tell(text)
    assert tracker.history == ()


@pytest.mark.parametrize("value", BAD, ids=str)
def test_bad_motion(value, harbour):
    tracker = CityTracker(harbour)
    calls = [(tracker.move, (value, 0.0)), (tracker.move, (0.0, value)), (tracker.walk, (value,))]
    options = [(tracker.walk, (1.0,), "bearing_sigma")]
    if value is not None:
        calls.append((tracker.walk, (1.0, value)))
        options += [(tracker.move, (0.0, 0.0), "sigma"), (tracker.walk, (1.0,), "distance_sigma")]
        options.append((CityTracker, (harbour,), "heading"))
    for call, arguments in calls:
        with pytest.raises(OptionError):
            call(*arguments)
    for call, arguments, option in options:
        with pytest.raises(OptionError):
            call(*arguments, **{option: value})
    assert tracker.history == ()


@pytest.mark.parametrize(
    "options",
    [
        {"top": 0}, {"top": 2.5}, {"top": True}, {"near": (200.0, 10.0)}, {"near": (1.0,)},
        {"near": "9.99,53.55"}, {"near": (9.99, 53.55), "radius": 0.0},
        {"near": (9.99, 53.55), "radius": "wide"}, {"near": (float("nan"), 53.55)},
    ],
    ids=str,
)  # fmt: skip
def test_bad_options(options, harbour):
    with pytest.raises(OptionError):
        CityTracker(harbour, **options)


def test_negative_motion(harbour):
    tracker = CityTracker(harbour)
    with pytest.raises(OptionError):
        tracker.walk(-1.0)
    with pytest.raises(OptionError):
        tracker.move(1.0, 1.0, sigma=-1.0)


STEP = st.one_of(
    st.sampled_from([*SENTENCES, "I walked 80 m north-west.", "I turned left.", "I went on.",
                     "I drove 2 km south.", "zzz", "I walked along Speicherweg to the museum."]),
    st.tuples(st.floats(-400, 400), st.floats(-400, 400), st.none() | st.floats(0, 200)),
    st.tuples(st.floats(0, 900), st.none() | st.floats(-7, 7)),
)  # fmt: skip


@settings(max_examples=25)
@given(st.lists(STEP, min_size=1, max_size=6))
def test_whatever_happens_probability_is_probability(harbour, steps):
    tracker = CityTracker(harbour)
    for step in steps:
        if isinstance(step, str):
            estimate = tracker.tell(step)
        elif len(step) == 3:
            estimate = tracker.move(*step[:2], sigma=step[2])
        else:
            estimate = tracker.walk(*step)
        sound(estimate, harbour)
        assert 0.0 <= tracker.elsewhere <= 1.0
        on_map = float(tracker._measurement.current.mass.sum(dtype=np.float64))
        assert on_map + tracker.elsewhere == pytest.approx(1.0, abs=1e-4)
        assert estimate.support[:, 2].sum() + tracker.elsewhere <= 1.0 + 1e-4
    assert len(tracker.history) == len(steps)
