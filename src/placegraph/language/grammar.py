"""A grammar as a table of states (LALR), made by lark once and kept."""

from __future__ import annotations

import json
from hashlib import sha256
from typing import TYPE_CHECKING, Any, NamedTuple

from placegraph.kept import kept

if TYPE_CHECKING:
    from collections.abc import Callable

END = "$END"


class UnexpectedTokenError(Exception):
    """The grammar has no place for a token here."""


class _Rule(NamedTuple):
    origin: str
    length: int
    inlined: list[bool]
    """For each symbol: whether its children stand in for it."""
    single: bool
    """Whether an only child stands for the whole."""
    build: Callable[[list[Any]], Any]


class Grammar:
    """A grammar of lark whose terminals are all declared, and what its rules become.

    Parameters
    ----------
    text, start
        The grammar and its first rule.
    builder
        Has a method for each rule, or its alias, that is called with the children once the rule is
        complete. Rules whose names begin with an underscore have none: their children stand in for
        them.
    """

    def __init__(self, text: str, start: str, builder: object) -> None:
        digest = sha256(f"1 {start} {text}".encode()).hexdigest()[:16]
        table = kept(f"grammar-{digest}.json", lambda: _table(text, start), json.loads)
        self._states: list[dict[str, int]] = table["states"]
        self._first: int = table["start"]
        self._last: int = table["end"]
        self._rules = [
            _Rule(origin, len(inlined), inlined, single, getattr(builder, name) if name else list)
            for origin, name, inlined, single in table["rules"]
        ]

    def parse(self) -> Parse:
        """Begin to parse."""
        return Parse(self._states, self._rules, self._first, self._last)


class Parse:
    """A parse under way: states and values of what is not yet complete."""

    def __init__(
        self, states: list[dict[str, int]], rules: list[_Rule], first: int, last: int
    ) -> None:
        self._table, self._rules, self._last = states, rules, last
        self._states = [first]
        self._values: list[Any] = [None]

    def feed(self, kind: str, value: Any = None) -> Any:  # noqa: ANN401  # what the builder makes
        """Take a token in; at `END`, what the whole has become.

        Raises
        ------
        UnexpectedTokenError
            The grammar has no place for it; rules that were complete before it have been built.

        """
        states, values = self._states, self._values
        while True:
            action = self._table[states[-1]].get(kind)
            if action is None:
                raise UnexpectedTokenError(kind)
            if action >= 0:
                states.append(action)
                values.append(value)
                return None
            rule = self._rules[-1 - action]
            first = len(values) - rule.length
            children = values[first:]
            del values[first:], states[first:]
            if True in rule.inlined:
                each = zip(children, rule.inlined, strict=True)
                children = [c for child, inlined in each for c in (child if inlined else (child,))]
            alone = rule.single and len(children) == 1
            values.append(children[0] if alone else rule.build(children))
            states.append(self._table[states[-1]][rule.origin])
            if kind == END and states[-1] == self._last:
                return values[-1]


def _table(text: str, start: str) -> bytes:
    """JSON of the states, in which a token leads to another state (0 ...) or completes a rule (-1 ...)."""
    from lark import Lark
    from lark.grammar import Rule
    from lark.lexer import Lexer, TerminalDef

    class NoLexer(Lexer):
        def __init__(self, _conf: object) -> None: ...
        def lex(self, *_: object) -> Any: ...  # noqa: ANN401  # tokens come one by one

    lark = Lark(text, start=start, parser="lalr", lexer=NoLexer, maybe_placeholders=False)
    told, memo = lark.memo_serialize([TerminalDef, Rule])
    table = told["parser"]["parser"]
    rules = {key: rule for key, rule in memo.items() if rule["__type__"] == "Rule"}
    number = {key: n for n, key in enumerate(rules)}
    made = {
        "states": [
            {
                table["tokens"][token]: -1 - number[to["@"]] if completes else to
                for token, (completes, to) in table["states"][state].items()
            }
            for state in range(len(table["states"]))
        ],
        "rules": [_rule(rule) for rule in rules.values()],
        "start": table["start_states"][start],
        "end": table["end_states"][start],
    }
    return json.dumps(made, separators=(",", ":")).encode()


def _rule(rule: dict[str, Any]) -> tuple[str, str, list[bool], bool]:
    """Origin, name of what builds it, which symbols are inlined, whether one child stands alone."""
    origin, alias = rule["origin"]["name"], rule["alias"]
    inlined = [
        symbol["__type__"] == "NonTerminal" and symbol["name"].startswith("_")
        for symbol in rule["expansion"]
    ]
    single = rule["options"]["expand1"] and not alias
    unbuilt = origin.startswith("_") or (single and inlined == [False])
    return origin, alias or ("" if unbuilt else origin), inlined, single
