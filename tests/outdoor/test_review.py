import itertools

import pytest


def test_saying_it_again_makes_it_no_surer(harbour):
    once = harbour.locate("A bench is north of the tree.")
    often = harbour.locate("A bench is north of the tree. " * 150)
    assert often.best.probability == pytest.approx(once.best.probability, abs=1e-6)


def test_hundreds_of_statements_do_not_overflow(harbour):
    things = ["bench", "tree", "bakery", "church", "fountain", "building", "road", "cafe", "school"]
    text = " ".join(
        f"The {a} is on the {wind} of the {b}."
        for a, b in itertools.permutations(things, 2)
        for wind in ("north", "east", "south", "west")
    )
    assert harbour.locate(text).status.name in ("LOST", "AMBIGUOUS", "OK")


@pytest.mark.parametrize(
    "text",
    [
        "St. Marien is north of me. St. Marien is south of me.",
        "Bäckerei Kern is north of St. Marien. St. Marien is north of Bäckerei Kern.",
    ],
)
def test_one_thing_cannot_lie_on_both_sides(harbour, text):
    estimate = harbour.locate(text)
    assert estimate.status.name == "LOST"
    assert "contradicts" in estimate.reason


def test_rare_things_out_of_sight_of_each_other_still_tell(harbour):
    estimate = harbour.locate("Bäckerei Kern is north of St. Marien.")
    assert estimate.status.name != "LOST"
    kern = harbour.locate("I am at Bäckerei Kern.").best
    here, there = (harbour.plane.to_plane((p.longitude, p.latitude)) for p in (estimate.best, kern))
    assert abs(here - there).max() < 120.0


def test_only_what_is_absent_is_no_place(harbour):
    estimate = harbour.locate("no trees here")
    assert estimate.status.name == "LOST"
    assert "absent" in estimate.reason
    assert estimate.modes == ()


def test_an_unknown_name_is_said_to_be_unknown(harbour):
    estimate = harbour.locate("I see Zzyzx Church")
    notes = " ".join(e.note for e in estimate.evidence)
    assert "Zzyzx" in notes or "Zzyzx" in estimate.reason


@pytest.mark.parametrize(
    "text",
    [
        "A bakery is east of me. A tram stop is south of me. A tree is north of me.",
        "A bench is west of me. A fountain is north-east of me. A café is east of me. I see a tree.",
        "A church is south of me. There is a park to the west. A road is north of me.",
    ],
)
def test_sentences_in_another_order_say_the_same(harbour, text):
    expected = harbour.locate(text)
    for said in itertools.permutations(text.split(". ")):
        found = harbour.locate(". ".join(s.removesuffix(".") for s in said) + ".")
        assert found.status is expected.status
        for mode, other in zip(found.modes, expected.modes, strict=True):
            assert mode.probability == pytest.approx(other.probability, abs=1e-6)
            assert (mode.longitude, mode.latitude) == pytest.approx(
                (other.longitude, other.latitude), abs=1e-7
            )
