from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from math import degrees, radians
from pathlib import Path

import pytest

from placegraph.errors import InputError, OptionError
from placegraph.language.text import IgnoredText
from placegraph.outdoor.language import describe
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Relation
from placegraph.outdoor.language.languages import tables
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.names import NameIndex

MEANING = re.compile(
    r"(?P<no>not )?(?P<relation>\w+)\((?P<nodes>[^)]*)\)(?: (?P<bearing>\d+)°)?(?: (?P<far>\d+)m)?"
)
SURE = 0.5
"""A thing's word must have the meant label at least with this weight."""


HAND = Path(__file__).parent / "hand"
"""Sentences that people wrote before they looked at a table, as "text @heading => meaning | meaning"."""


def examples():
    """Examples by language: text, heading [degrees] or none, and what they mean."""
    found = {}
    for file in sorted(HAND.glob("*.txt")):
        for line in file.read_text("utf-8").splitlines():
            text, _, meaning = line.partition(" => ")
            text, _, heading = text.partition(" @")
            angle = float(heading) if heading else None
            found.setdefault(file.stem, []).append((text, angle, meaning.split(" | ")))
    for code, table in sorted(tables().items()):
        for example in tomllib.loads(table.read_text("utf-8")).get("examples", ()):
            row = (example["text"], example.get("heading"), example["means"])
            found.setdefault(code, []).append(row)
    return found


EXAMPLES = examples()


def means(mention, word):
    """Whether a mention is what an example means: a "name" in quotes, or an English word."""
    if word[0] == '"':
        return mention.name.casefold() == word.strip('"').casefold()
    (meant, *_) = Vocabulary.default().senses(word)
    return any(s.label == meant.label and s.weight >= SURE for s in mention.senses)


def is_said(statement, meaning, description):
    told = MEANING.fullmatch(meaning)
    assert told, f"{meaning!r} is no meaning: write as 'direction(bakery, I) 90° 50m'"
    nodes = [n for n in (statement.source, statement.target, statement.target2) if n is not None]
    words = told["nodes"].split(", ")
    return (
        statement.relation == told["relation"]
        and statement.negated == bool(told["no"])
        and (None if statement.bearing is None else round(degrees(statement.bearing)) % 360)
        == (None if told["bearing"] is None else int(told["bearing"]))
        and (None if statement.distance is None else round(statement.distance))
        == (None if told["far"] is None else int(told["far"]))
        and len(nodes) == len(words)
        and all(
            node == {"I": SPEAKER, "you": LISTENER}[word]
            if word in ("I", "you")
            else node > LISTENER and means(description.mentions[node], word)
            for node, word in zip(nodes, words, strict=True)
        )
    )


@pytest.mark.parametrize("code", EXAMPLES)
def test_examples(code):
    wrong = []
    for text, heading, wanted in EXAMPLES[code]:
        description = describe(text, heading=None if heading is None else radians(heading))
        left, missing = list(description.statements), []
        for meaning in wanted:
            found = next((s for s in left if is_said(s, meaning, description)), None)
            if found is None:
                missing.append(meaning)
            else:
                left.remove(found)
        if description.language != code or missing or left:
            wrong.append((text, description.language, missing, left, description.ignored))
    assert not wrong


@pytest.mark.parametrize(
    ("text", "language", "said"),
    [
        ("30 m north of the Kirche", "en", 1), ("Bakery, restaurant, museum, park.", "en", 4),
        ("a church", "en", 1), ("I see Кафе Пушкин", "en", 1),
        ("The bakery is north of me. Die Kirche ist östlich der Bäckerei.", "de", 2),
        ("\u202bDie \u200fKirche\u202c ist nörd\u00adlich von mir.", "de", 1),
        ("ｔｈｅ　ｂａｋｅｒｙ　ｉｓ　ｎｏｒｔｈ　ｏｆ　ｍｅ", "en", 1), ("ﾊﾟﾝ屋は教会の北です。", "ja", 1),
        ("Die bicycle_parking liegt südlich der amenity=bench.", "de", 1), ("où suis-je", "fr", 0),
        ("Ich stehe vor einer Bank in der Wall Street.", "de", 2),
        ("Estoy delante de un banco en la calle East.", "es", 2),
        ("Je suis devant The North Face, près d'une banque.", "fr", 2),
        ("MEET ME AT THE BANK", "en", 1),
    ],
)  # fmt: skip
def test_the_language_is_recognised_whatever_the_letters(text, language, said):
    description = describe(text)
    assert (description.language, len(description.statements)) == (language, said)
    assert description.text == text


@pytest.mark.parametrize("text", ["A templom északra van tőlem.", "Kostel je na sever od školy."])
def test_what_is_in_no_known_language_is_told(text):
    description = describe(text)
    assert description.language == ""
    assert description.ignored[-1] == IgnoredText(text, "in an unknown language")


def test_a_language_that_there_is_not():
    with pytest.raises(OptionError, match=r"language is 'xx'; choose one of .*de, .*fi, .*ja"):
        describe("A church.", language="xx")


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        ("[who]\nME = ['i']", "the field 'name' is missing"),
        ("name = 'X'\n[who]\nME = 'i'", r"the field 'who\.ME' is 'i'; write a list of phrases"),
        ("name = 'X'\n[who]\nMI = ['i']", "the key 'MI' of 'who' is unknown; choose from"),
        ("name = 'X'\n[compass]\n10 = ['i']", "the key '10' of 'compass' is unknown"),
        ("name = 'X'\n[compas]\n0 = ['i']", "the field 'compas' is unknown"),
        ("name = 'X'\n[forms]\nchanges = ['kk']", r"the field 'forms\.changes' is"),
        ("name = 'X'\n[measures.units]\nm = ['m']", r"the key 'm' of 'measures\.units'"),
        ("name = ", "it is not a language"),
    ],
)
def test_a_malformed_table_is_told_by_file_and_field(table, fault, tmp_path):
    (tmp_path / "languages").mkdir()
    (tmp_path / "languages/qq.toml").write_text(table, "utf-8")
    with pytest.raises(InputError, match=rf"qq\.toml: .*{fault}"):
        Vocabulary.load(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "Ég stend hjá Palais Aurore. Norðan við mig er stórt tré og austan við mig er brú.",
        "Tôi đang đứng gần Jardin Des Enfants. Phía bắc có một cái cây to, phía đông là cầu.",
        "Kütüphane köprünün doğusunda alıyor. yer",  # a sentence of one adverb, which is left out
    ],
)
def test_little_evidence_is_no_error(text):
    assert describe(text).text == text


@dataclass(frozen=True)
class Names:
    names: tuple[str, ...]


HEBREW = NameIndex.build(
    Names(
        (
            "בית המשפט העליון",
            'בי"ס אורט',
            "הספריה הלאומית",
            "מרכז קהילתי בית רוס",
            "יפו",
            "שמואל הנגיד",
        )
    )
)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("אני ליד בית המשפט העליון.", ["בית המשפט העליון"]),
        ("הבנק נמצא מצפון לספרייה הלאומית.", ["ספרייה הלאומית"]),
        ("אני בבית הספר אורט, ברחוב יפו.", ["בית הספר אורט", "רחוב יפו"]),
        ("אני ליד המרכז הקהילתי בית רוס.", ["המרכז הקהילתי בית רוס"]),
        ("אני בין רחוב יפו לשמואל הנגיד.", ["רחוב יפו", "שמואל הנגיד"]),
        ("אני ליד הבית.", []),
    ],
)
def test_names_of_the_map_are_sought_before_prefixes_are_cut(text, named):
    description = describe(text, names=HEBREW)
    assert [m.name for m in description.mentions if m.name] == named
    assert description.ignored == ()


def read_named():
    """Read sentences with names of a map: language, names of the map, text, and what is named."""
    for line in (HAND.parent / "names.txt").read_text("utf-8").splitlines():
        if line.startswith("["):
            code, _, listed = line[1:].partition("] ")
        elif not line.startswith("#"):
            text, _, meant = line.partition(" => ")
            yield pytest.param(
                listed.split("; "), text, set(meant.split("; ")), id=f"{code}: {text}"
            )


@pytest.mark.parametrize(("listed", "text", "meant"), list(read_named()))
def test_names_in_any_language_script_and_form(listed, text, meant):
    """Inflected, in compounds, without spaces or diacritics, shortened, in other letters."""
    index = NameIndex.build(Names(tuple(listed)))
    description = describe(text, names=index)
    nodes = {n for s in description.statements for n in (s.source, s.target, s.target2)} - {None}
    mentions = [description.mentions[n] for n in nodes]
    found = {listed[row] for m in mentions if m.name for row in index.find_rows(m.name)}
    assert found == {name for name in meant if name[0] != "("}
    for word in meant - found:
        assert any(means(m, word.strip("()")) for m in mentions)


def test_the_ends_of_a_text_make_no_name():
    names = NameIndex.build(Names(("Elms Hill",)))
    description = describe("Hill blorf gwyn Elms", names=names)
    assert not any(m.name == "elms hill" for m in description.mentions)


def test_no_name_is_cut_out_of_a_tag():
    names = NameIndex.build(Names(("Men",)))
    description = describe("花屋はamenity=spaの西にあります。", names=names)
    assert [m.words for m in description.mentions[2:]] == ["花屋", "amenity=spa"]


@pytest.mark.parametrize("text", ["Park Avenue", "180 West 11th Avenue"])
def test_an_english_avenue_is_not_french(text):
    assert describe(text).language == "en"


def test_a_name_that_no_statement_speaks_of_is_near():
    names = NameIndex.build(Names(("Kiosk am Eck", "Zum Hirsch")))
    text = "Ich war gestern, so sagt man, wohl ganz blorf Zum Hirsch."
    description = describe(text, names=names, language="de")
    assert [(s.relation, s.certainty) for s in description.statements] == [(Relation.NEAR, 0.5)]


@pytest.mark.parametrize(
    ("text", "language", "meaning"),
    [
        ("estoi serca del cafe expres y la farmasia", "es", ["near(I, cafe)", "near(I, pharmacy)"]),
        ("estoi al lado de la iglecia", "es", ["near(I, church)"]),
        ("je suis a cote de la farmacie", "fr", ["near(I, pharmacy)"]),
        ("ich bin neben der apoteke", "de", ["near(I, pharmacy)"]),
        ("Estoy en la avenida venezuela.", "es", ['along(I, "avenida venezuela")']),
        ("Estoy en una calle peatonal.", "es", None),
        ("sono in via garibaldi, vicino alla chiesa", "it", ['along(I, "via garibaldi")', "near(I, church)"]),
    ],
)  # fmt: skip
def test_colloquial_spelling(text, language, meaning):
    description = describe(text)
    assert description.language == language
    if meaning is None:
        assert not any(m.name for m in description.mentions)
        return
    for wanted in meaning:
        assert any(is_said(s, wanted, description) for s in description.statements), description


@pytest.mark.parametrize("code", EXAMPLES)
def test_the_grammar_reads_no_fewer_things_than_names_alone(code):
    """Without its grammar a language is read by names and kinds in any order."""
    found = {True: 0, False: 0}
    for text, heading, wanted in EXAMPLES[code]:
        words = {word for told in wanted for word in MEANING.fullmatch(told)["nodes"].split(", ")}
        for grammar in found:
            angle = None if heading is None else radians(heading)
            description = describe(text, heading=angle, language=code, grammar=grammar)
            nodes = {n for s in description.statements for n in (s.source, s.target, s.target2)}
            mentions = [description.mentions[n] for n in nodes - {None, SPEAKER, LISTENER}]
            found[grammar] += sum(
                any(means(m, word) for m in mentions) for word in words - {"I", "you"}
            )
    assert found[True] >= found[False] > 0


def test_names_and_kinds_alone():
    names = NameIndex.build(Names(("Zum Hirsch",)))
    description = describe("Östlich vom Zum Hirsch liegt keine Bank.", names=names, grammar=False)
    found = [(str(s.relation), s.negated) for s in description.statements]
    assert sorted(found) == [("near", False), ("visible", False)]
