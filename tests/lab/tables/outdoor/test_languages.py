import pytest

from placegraph.outdoor.language import describe
from placegraph.outdoor.language.languages import codes
from placegraph_lab.tables.named.languages import (
    list_languages,
    read_placed,
    score_placed,
    translate_queries,
)
from placegraph_lab.tables.outdoor.extracts import Extract

PLACED = read_placed()


@pytest.fixture(scope="module")
def texts(town):
    return dict(translate_queries(town, 5, 0))


@pytest.mark.parametrize("code", list_languages())
def test_what_is_said_in_a_language_is_read(texts, code):
    asked = read = 0
    for text, query in texts[code]:
        description = describe(text)
        assert description.language == code, text
        asked += len(query.statements)
        read += sum(s.relation == "direction" for s in description.statements)
    assert read >= 0.9 * asked


def test_placed_sentences_are_of_known_languages_and_each_once():
    assert {code for code, _ in PLACED} <= set(codes())
    texts = [row.text for rows in PLACED.values() for row in rows]
    assert len(texts) == len(set(texts))
    assert len(PLACED["he", "jerusalem_2016"]) == 60


@pytest.mark.all
@pytest.mark.parametrize(("code", "extract"), PLACED)
def test_grammar_reads_no_language_worse_than_names_alone(code, extract, shared, tmp_path):
    city = Extract(extract, shared / f"data/osm/{extract}.osm.pbf").open(tmp_path)
    rows = PLACED[code, extract]
    read, named = (score_placed(city, rows, grammar=grammar) for grammar in (True, False))
    assert read["near"] >= named["near"]
    assert read["block"] >= named["block"]
    assert read["wrong_of_ok"] <= 0.05
