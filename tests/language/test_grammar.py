from __future__ import annotations

import pytest

from placegraph.core import cache
from placegraph.language import grammar
from placegraph.language.grammar import END, Grammar, UnexpectedTokenError

TEXT = """
list: _item (COMMA _item)*
_item: word | both
both: pair
?word: A | NOT word -> negated
pair: A B
%declare A B NOT COMMA
"""


BUILD = {
    "list": lambda children: ("list", *children),
    "negated": lambda children: ("not", children[-1]),
    "pair": tuple,
    "both": lambda children: ("both", *children),
}


@pytest.fixture
def folder(tmp_path):
    before = cache.FOLDERS.chosen
    cache.FOLDERS.choose(tmp_path)
    yield tmp_path
    cache.FOLDERS.choose(before)


@pytest.mark.usefixtures("folder")
def test_rules_are_built_inlined_and_skipped_over():
    parse = Grammar(TEXT, "list", BUILD).parse()
    for kind in ("NOT", "NOT", "A", "COMMA", "A", "B"):
        assert parse.feed(kind, kind.lower()) is None
    assert parse.feed(END) == ("list", ("not", ("not", "a")), "comma", ("both", ("a", "b")))


@pytest.mark.usefixtures("folder")
def test_what_has_no_place_is_refused_and_the_rest_goes_on():
    parse = Grammar("pair: A B\n%declare A B", "pair", BUILD).parse()
    parse.feed("A", 1)
    with pytest.raises(UnexpectedTokenError):
        parse.feed("A", 2)
    parse.feed("B", 3)
    assert parse.feed(END) == (1, 3)


def test_a_table_is_made_once_and_again_where_it_is_damaged(folder, monkeypatch):
    made = []
    table = grammar._table
    monkeypatch.setattr(grammar, "_table", lambda *given: made.append(1) or table(*given))
    for content in ("", "{"):
        Grammar("pair: A B\n%declare A B", "pair", BUILD)
        Grammar("pair: A B\n%declare A B", "pair", BUILD)
        (file,) = folder.iterdir()
        file.write_text(content)
    assert len(made) == 2


@pytest.mark.usefixtures("folder")
def test_a_rule_that_nothing_builds_is_told():
    with pytest.raises(KeyError, match="other"):
        Grammar("other: A B\n%declare A B", "other", BUILD)
