import pytest

from placegraph.outdoor.language import describe
from placegraph_lab.tables.named.languages import list_languages, translate_queries


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
