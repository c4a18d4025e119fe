"""The statements of a query, said in every language, are read as the statements that they are."""

import pytest

from placegraph.outdoor.language import describe
from placegraph_lab.tables.named.languages import spoken, translate_queries
from placegraph_lab.worlds.town.town import Town


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    osm = Town.load("hafenstadt").write_osm(tmp_path_factory.mktemp("town") / "town.osm")
    return dict(translate_queries(osm, 5, 0))


@pytest.mark.parametrize("code", spoken())
def test_what_is_said_in_a_language_is_read(texts, code):
    asked = read = 0
    for text, query in texts[code]:
        description = describe(text)
        assert description.language == code, text
        asked += len(query.statements)
        read += sum(s.relation == "direction" for s in description.statements)
    assert read >= 0.9 * asked
