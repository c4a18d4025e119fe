import itertools
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.estimate import CityEstimate, Status
from placegraph.errors import OptionError
from placegraph.outdoor.city import build_city
from placegraph.outdoor.language.description import SPEAKER, Description, Relation
from placegraph.outdoor.language.languages import codes, read_answers, translate
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.objects import find_hidden
from placegraph.outdoor.search.ask import (
    MIN_CHANGE,
    NO,
    NONE,
    UNKNOWN,
    YES,
    Answer,
    Places,
    Question,
    Subject,
    _make_choice_question,
    _rank_yes_no_questions,
    _Surroundings,
    compute_gain,
    moves_posterior,
    next_question,
    rank_questions,
)
from placegraph.outdoor.search.status import ADVICE
from placegraph_lab.worlds.town.town import Town

SQUARES = "I am standing on a square. There is a fountain north of me and a café to my east."
# What somebody says who sees little, and the places it may have been said at: row and column.
VAGUE = [
    ("I am standing on a square near a fountain.", [(4, 38), (30, 58)]),
    ("There is a bench next to me.", [(2, 70), (4, 85), (7, 37), (13, 82), (17, 4), (17, 29)]),
    ("A bakery is near me.", [(6, 27), (31, 85)]),
    ("I am at a tram stop.", [(11, 24), (11, 61)]),
    ("I'm next to a café.", [(4, 40), (30, 61)]),
]


class Speaker:
    """Somebody in a city who answers truthfully by what is there."""

    def __init__(self, city, position, sight=35.0):
        o = city.objects
        self.seen = []
        for row in range(len(o)):
            east, north, d2 = nearest_on_parts(
                o.part_starts, o.point_starts, o.points, o.kind[row], row, *map(float, position)
            )
            if d2 <= sight**2:
                wind = "" if d2 < 1 else self.wind(east, north)
                self.seen.append((o.label(row), o.name(row), wind, d2))

    @staticmethod
    def wind(east, north):
        if abs(east) > abs(north):
            return "east" if east > 0 else "west"
        return "north" if north > 0 else "south"

    def answer(self, question):
        if question.options == (YES, NO):
            thing = question.subjects[0]
            there = any(
                label == thing.label and thing.wind in ("", wind) for label, _, wind, _ in self.seen
            )
            return question.answer(YES if there else NO)
        named = sorted((d2, name) for _, name, _, d2 in self.seen if name in question.options)
        return question.answer(named[0][1] if named else NONE)


def truth(city, town, cell):
    return city.plane.to_plane(town.lonlat(cell[0] + 0.5, cell[1] + 0.5))


def probability(estimate, city, position):
    """Probability of the place lying within 50 m of a position [m]."""
    at = city.plane.to_plane(estimate.support[:, :2])
    return float(estimate.support[np.hypot(*(at - position).T) <= 50.0, 2].sum())


def entropy(p):
    return -sum(x * np.log(x) for x in p if x > 0)


@st.composite
def tables(draw):
    """P(place) and P(answer | place)."""
    places, options = draw(st.integers(1, 5)), draw(st.integers(2, 4))
    numbers = st.floats(0.01, 1.0)
    weights = np.array(draw(st.lists(numbers, min_size=places, max_size=places)))
    rows = [draw(st.lists(numbers, min_size=places, max_size=places)) for _ in range(options)]
    answers = np.array(rows)
    return weights / weights.sum(), answers / answers.sum(axis=0)


@given(tables())
def test_gain_is_mutual_information(table):
    weights, answers = table
    gain = compute_gain(weights, answers)
    joint = answers * weights
    brute = sum(
        joint[a, k] * np.log(joint[a, k] / (joint[a].sum() * weights[k]))
        for a in range(len(answers))
        for k in range(len(weights))
    )
    assert gain == pytest.approx(brute, abs=1e-9)
    assert -1e-9 <= gain <= min(entropy(weights), np.log(len(answers))) + 1e-9


def test_gain_of_yes_or_no_counts_the_places_where_nothing_is_expected():
    weights, expected = np.array([0.2, 0.3, 0.5]), np.array([[0.4, 0.0, 2.0], [0.0, 0.0, 0.1]])
    pairs = np.array(np.nonzero(expected))
    sparse = np.zeros((5, len(pairs[0])))
    sparse[0] = expected[tuple(pairs)]
    around = _Surroundings(["amenity=bench", "amenity=bank"], pairs, sparse, [], np.zeros((0, 3)))
    for question in _rank_yes_no_questions(weights, around, "en"):
        row = expected[around.labels.index(question.subjects[0].label)]
        yes = 0.05 + 0.9 * -np.expm1(-2.0 * row)
        assert question.gain == pytest.approx(compute_gain(weights, np.stack([yes, 1.0 - yes])))


def test_the_best_question_is_asked(harbour):
    estimate = harbour.locate(SQUARES)
    question = estimate.next_question(harbour)
    everything = list(rank_questions(estimate, harbour))
    assert question.gain == everything[0].gain > 0.02
    assert [q.gain for q in everything] == sorted((q.gain for q in everything), reverse=True)
    assert question == next_question(estimate, harbour)
    assert question == harbour.locate(SQUARES).next_question(harbour)
    for q in everything:
        assert q.text.endswith("?")
        assert q.gain >= -1e-9
        assert len(q.options) >= 2
        assert len(set(q.options)) == len(q.options)
        assert len(q.subjects) == (1 if q.options == (YES, NO) else len(q.options) - 1)


def test_questions_are_about_what_is_on_the_map(real_city):
    estimate = real_city.locate("I am next to a bench.")
    known = set(real_city.objects.labels) | set(real_city.objects.names)
    for question in rank_questions(estimate, real_city):
        for thing in question.subjects:
            assert (thing.label or thing.words) in known


def test_nothing_is_around_a_place_far_from_every_viewpoint(harbour):
    with np.errstate(over="raise"):
        at = np.array([[1e5, 1e5]])
        around = _Surroundings.of_places(harbour, Places(np.ones(1), at, harbour.in_sight([0])))
    assert around.expected.max() < 1e-9


def test_nothing_to_ask(harbour):
    for text in ("A lighthouse is north of me.", "asdf qwer"):
        estimate = harbour.locate(text)
        assert estimate.status == Status.LOST
        assert estimate.next_question(harbour) is None
    clear = harbour.locate("I am on Speicherweg. The bank is north of me, the hairdresser west.")
    assert clear.best.probability > 0.8
    assert clear.next_question(harbour) is None
    assert CityEstimate(Status.LOST, (), "Nothing.").next_question(harbour) is None


CHOICE = Question("Which?", ("Kern", "Brot", NONE), (Subject("Kern"), Subject("Brot")), 0.5)
BENCH = Question("Is there a bench?", (YES, NO), (Subject("bench", "amenity=bench", "north"),), 0.5)


@pytest.mark.parametrize(
    ("question", "given_", "expected"),
    [
        (BENCH, "yes", YES), (BENCH, " YES ", YES), (BENCH, "y", YES), (BENCH, "Y", YES),
        (BENCH, "no", NO), (BENCH, "n", NO), (BENCH, "don't know", UNKNOWN),
        (BENCH, "Don't Know", UNKNOWN), (CHOICE, "kern", "Kern"), (CHOICE, "Brot\n", "Brot"),
        (CHOICE, "none of these", NONE), (CHOICE, "n", NONE), (CHOICE, "No", NONE),
        (CHOICE, "none", NONE), (CHOICE, "DON'T KNOW", UNKNOWN),
    ],
)  # fmt: skip
def test_answers_that_count(question, given_, expected):
    assert question.answer(given_) == Answer(question, expected)


@pytest.mark.parametrize(
    ("question", "given_"),
    [
        (BENCH, ""), (BENCH, " "), (BENCH, "maybe"), (BENCH, "yess"), (BENCH, "Kern"),
        (CHOICE, "yes"), (CHOICE, "y"), (CHOICE, "k"), (CHOICE, "Kern, Brot"), (CHOICE, ""),
        (BENCH, None), (BENCH, 1), (BENCH, True), (CHOICE, ["Kern"]),
    ],
)  # fmt: skip
def test_answers_that_do_not(question, given_):
    with pytest.raises(OptionError, match=r"is not a valid answer; choose one of: .*don't know"):
        question.answer(given_)


def test_answers_become_statements():
    empty = Description("")
    yes = BENCH.answer("yes").added_to(empty)
    [statement] = yes.statements
    assert (statement.relation, statement.target) == (Relation.DIRECTION, SPEAKER)
    assert (statement.bearing, statement.negated) == (0.0, False)
    assert yes.mentions[statement.source].senses[0].label == "amenity=bench"
    assert BENCH.answer("no").added_to(empty).statements[0].negated
    kern = CHOICE.answer("Kern").added_to(empty)
    assert [kern.mentions[s.source].name for s in kern.statements] == ["Kern"]
    assert not kern.statements[0].negated
    none = CHOICE.answer("none of these").added_to(empty)
    assert [none.mentions[s.source].name for s in none.statements] == ["Kern", "Brot"]
    assert all(s.negated for s in none.statements)


def test_not_knowing_changes_nothing_but_the_question(harbour):
    estimate = harbour.locate(SQUARES)
    question = estimate.next_question(harbour)
    again = harbour.locate(SQUARES, answers=[question.answer("don't know")])
    assert [m.probability for m in again.modes] == [m.probability for m in estimate.modes]
    np.testing.assert_array_equal(again.support, estimate.support)
    following = again.next_question(harbour)
    assert following is None or following.text != question.text


@pytest.mark.parametrize("answer", ["yes", ("question", "yes"), None, 5])
def test_what_is_no_answer(answer, harbour):
    with pytest.raises(OptionError, match=r"question\.answer"):
        harbour.locate(SQUARES, answers=[answer])


def test_no_question_comes_twice(harbour):
    answers, texts = [], []
    for given_ in ("no", "don't know", "no", "don't know", "no", "no"):
        estimate = harbour.locate("I am next to a bench.", answers=answers)
        question = estimate.next_question(harbour)
        if question is None:
            break
        assert question.text not in texts
        texts.append(question.text)
        answers.append(question.answer(given_ if given_ in (*question.options, UNKNOWN) else NONE))
    assert len(texts) >= 2


def test_the_answers_stand_in_the_evidence(harbour):
    estimate = harbour.locate(SQUARES)
    question = estimate.next_question(harbour)
    position = harbour.plane.to_plane((estimate.best.longitude, estimate.best.latitude))
    answered = harbour.locate(SQUARES, answers=[Speaker(harbour, position).answer(question)])
    assert any(question.text in e.statement for e in answered.evidence)


PLACES = [(text, cell) for text, cells in VAGUE for cell in cells]


def dialogue(text, city, position):
    """Estimates after 0, 1, 2 ... true answers, until one is OK."""
    speaker, answers = Speaker(city, position), []
    estimates = [city.locate(text)]
    while len(answers) < 8 and estimates[-1].status != Status.OK:
        question = estimates[-1].next_question(city)
        if question is None:
            break
        answers.append(speaker.answer(question))
        estimates.append(city.locate(text, answers=answers))
    return estimates


def test_true_answers_lead_to_the_true_place(harbour, hafenstadt):
    reached, gained, asked, steps = 0, 0, 0, []
    for text, cell in PLACES:
        position = truth(harbour, hafenstadt, cell)
        estimates = dialogue(text, harbour, position)
        truth_shares = [max(1e-6, probability(e, harbour, position)) for e in estimates]
        gained += truth_shares[-1] > truth_shares[0]
        steps += np.diff(np.log(truth_shares[:2])).tolist()
        best = estimates[-1].best
        off = np.hypot(*(harbour.plane.to_plane((best.longitude, best.latitude)) - position))
        reached += bool(estimates[-1].status == Status.OK and off < 50)
        asked += len(estimates) - 1
    assert gained >= len(PLACES) - 1
    assert reached >= 0.7 * len(PLACES)
    assert asked <= 4.5 * len(PLACES)
    assert len(steps) >= 8
    assert np.mean(steps) > 0.3


def test_names_of_the_same_words_are_one_choice():
    names = ["McDonald's", "McDonalds", "Blenz", "Esso"]
    named = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0.5]])
    around = _Surroundings([], np.zeros((2, 0), np.int64), np.zeros((5, 0)), names, named)
    (question,) = _make_choice_question(np.array([0.3, 0.25, 0.25, 0.2]), around, "")
    assert question.options == ("McDonald's", "Blenz", "Esso", NONE)
    named = np.maximum(named[1:], [[1, 0, 0, 0]] + 2 * [4 * [0]])
    merged = _Surroundings([], around.pairs, around.expected, names[1:], named)
    (same,) = _make_choice_question(np.array([0.3, 0.25, 0.25, 0.2]), merged, "")
    assert question.gain == pytest.approx(same.gain)


def test_questions_repeat_nothing_that_was_said(harbour):
    text = "There is a café at Fischmarkt or Rathausplatz, and a fountain to the north."
    questions = list(rank_questions(harbour.locate(text), harbour))
    assert len(questions) > 20
    asked = {(s.words, s.wind) for q in questions for s in q.subjects}
    assert asked.isdisjoint({("Fischmarkt", ""), ("Rathausplatz", ""), ("fountain", "")})
    assert asked.isdisjoint({("fountain", "north"), ("cafe", ""), ("café", "")})
    assert ("fountain", "south") in asked


LANGUAGES = ("ar", "de", "es", "fr", "pt", "ru", "zh")


def test_the_table_of_answers_is_whole():
    table = read_answers()
    assert sorted([*table, "en"]) == sorted(codes())  # all ask, and some give all reasons
    slots = re.compile(r"\{\d?\}")
    for code, sentences in table.items():
        asked = {e for e in table["es"] if not e.endswith(".")} - {"” and “"}
        assert sentences.keys() == table["es"].keys() or asked <= sentences.keys(), code
        assert code not in LANGUAGES or sentences.keys() == table["es"].keys(), code
        for english, said in sentences.items():
            assert len(slots.findall(said)) == english.count("{}"), (code, english)


def test_every_reason_is_in_the_table():
    """Reasons are those of tests/texts.txt; details that stay English and rankings are left out."""
    listed = (Path(__file__).parents[2] / "texts.txt").read_text("utf-8")
    reasons = []
    for file in ("search/status.py", "track/route_answer.py"):
        (_, section) = listed.split(f"# src/placegraph/outdoor/{file}\n")
        reasons += section.partition("\n#")[0].splitlines()
    for reason in reasons:
        shown = reason.replace("{} {} not", "“x” are not").replace("{},{}", "1,2")
        shown = (
            shown.replace("; {}", f"; {ADVICE}")
            .replace("and {}", f"and {ADVICE}")
            .replace("{}", "7")
        )
        if reason != ADVICE and not re.match(
            "No statement|The last text|The {} matcher|The desc", reason
        ):
            assert all(translate(shown, code) != shown for code in LANGUAGES), reason
            assert not re.search("[a-z]{4} [a-z]{4} [a-z]{3}", translate(shown, "zh")), reason


def test_a_reason_has_several_sentences_and_the_text_keeps_its_names():
    english = "The best place holds only 42% of the probability; others fit as well. Not understood: “f.o?”."
    assert translate(english, "es") == (
        "El mejor lugar solo tiene el 42% de la probabilidad; también encajan otros. No entendido: “f.o?”."
    )
    assert translate(english, "sv").startswith("Den bästa platsen")
    assert translate("One place holds 90% of the probability within 250 m.", "zh") == (
        "一个地点在250米内占90%的概率。"
    )


def test_questions_are_asked_and_answered_in_the_language_of_the_text(harbour):
    estimate = harbour.locate("Estoy en una plaza. Hay una fuente al norte.")
    assert "probabilidad" in estimate.reason
    question = estimate.next_question(harbour)
    assert question.text.startswith("¿")
    assert question.choices[-1] == "no sé"
    assert question.answer("no sé").option == UNKNOWN
    again = harbour.locate(
        "Estoy en una plaza. Hay una fuente al norte.", answers=[question.answer("no sé")]
    )
    assert again.next_question(harbour).text != question.text
    yes = replace(BENCH, language="es")
    assert (yes.answer("sí").option, yes.answer("n").option) == (YES, NO)


UNDERGROUND = """
[town]
name = Underground
center = 9.99 53.55

[drawing]
--1-----+---------
   b    |    b
 SS     |     KK
 SS     3     KK
~~~~~~~~s~~~~~~~~~
        |

[legend]
1 road: highway=residential name=Nordweg
3 road: highway=residential name=Kreuzweg
~ line: railway=subway name=Blaue Linie
b: amenity=bench
s: railway=station name=Mitte
S area: building=yes shop=bakery name=Kern
K area: building=yes amenity=cafe name=Mole
"""


def test_questions_are_about_what_can_be_seen(tmp_path):
    town = Town.parse(UNDERGROUND).write_osm(tmp_path / "u.osm")
    city = build_city(town, tmp_path / "u.city")
    hidden = find_hidden(city.objects)
    assert [city.objects.name(row) for row in hidden] == ["Blaue Linie"]
    asked = [q.text for q in rank_questions(city.locate("I am next to a bench."), city)]
    assert asked
    assert not any("Blaue Linie" in text or "subway" in text for text in asked)


def test_an_answer_moves_the_posterior_that_the_search_finds(real_city):
    text = "I am next to a bench."
    estimate = real_city.locate(text)
    question = estimate.next_question(real_city)
    shares = {tuple(p[:2]): p[2] for p in estimate.support.tolist()}
    moved = []
    for option in question.options:
        support = real_city.locate(text, answers=[question.answer(option)]).support
        after = {tuple(p[:2]): p[2] for p in support.tolist()}
        places = shares.keys() | after.keys()
        moved.append(0.5 * sum(abs(shares.get(k, 0.0) - after.get(k, 0.0)) for k in places))
    assert np.mean(moved) >= MIN_CHANGE
    ranked = itertools.takewhile(lambda q: q != question, rank_questions(estimate, real_city))
    places = Places.of_estimate(estimate, real_city)
    assert not any(moves_posterior(places, real_city, q) for q in ranked)


def test_plurals_have_no_article():
    around = _Surroundings(
        ["highway=steps"],
        np.array([[0], [0]]),
        np.array([[1.0]] + [[0.0]] * 4),
        [],
        np.zeros((0, 2)),
    )
    (question,) = _rank_yes_no_questions(np.array([0.5, 0.5]), around, "en")
    assert question.text == "Are there steps within sight?"


def test_german_nouns_are_written_large(harbour):
    ranked = rank_questions(harbour.locate("Ich stehe an einem Brunnen."), harbour)
    kinds = [q.subjects[0].words for q in ranked if q.options == (YES, NO)]
    assert kinds
    assert all(words[0].isupper() for words in kinds)
