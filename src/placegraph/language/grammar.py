"""A grammar at work, for both wings: chunks of a clause become phrases and a clause.

The grammar is a table of states (LALR), made by lark once and cached.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from typing import Any, Generic, NamedTuple, TypeVar

from placegraph.core.cache import load_or_make

LONGEST_CLAUSE = 60
"""Chunks of a clause at most; nobody speaks in longer ones."""
UNSURE = 0.6
"""Certainty of a clause that says "maybe"."""
_BACK = 4
"""Maximum number of chunks that are given up to parse the chunks before them."""
Noun = TypeVar("Noun")
Builders = Mapping[str, Callable[[list[Any]], Any]]
"""Functions that build a value from the children of each rule of a grammar."""


@dataclass(slots=True)
class Chunk:
    """A terminal of the grammar: a phrase of the text and what it stands for."""

    type: str
    start: int
    end: int
    """Characters of the text."""
    words: str = ""
    """Lower-case."""
    value: Any = None
    capital: bool = False


@dataclass(slots=True)
class PlacePhrase(Generic[Noun]):
    """A phrase that says where something is: "50 m north of the church", "on my left"."""

    how: str
    """Rule of the grammar: ``towards prep between related ...``."""
    start: int
    end: int
    targets: tuple[Noun, ...] = ()
    word: str = ""
    """Preposition: ``ON IN AT TO``, or a relation of the language."""
    direction: Any = None
    """Value of a DIR: a direction of the compass or the body."""
    distance: float | None = None
    part: str = ""
    owner: str = ""
    """``MY YOUR ITS``."""
    negated: bool = False


@dataclass(slots=True)
class Clause:
    """A clause: a verb, and the noun and place phrases before it and after it."""

    verb: str
    """Rule of the grammar: ``fragment is_ exists sees ...``."""
    before: tuple[Any, ...] = ()
    after: tuple[Any, ...] = ()
    negated: bool = False
    condition: bool = False
    """"if you see ...", "when you get to ...", "until ..."."""
    travel: str = ""
    """Type of the verb: ``GO PASS CROSS FOLLOW REACH``."""
    start: int = 0
    end: int = 0


def build_clause(children: list[Any], *, verb: str) -> Clause:
    """Build a clause of phrases (tuples) before and after a verb (a chunk)."""
    clause = Clause(verb)
    for child in children:
        if not isinstance(child, tuple):
            clause.travel, clause.negated = child.type, child.value == "NOT"
        elif clause.travel:
            clause.after = child
        else:
            clause.before = child
    return clause


def build_place(children: list[Any], *, how: str) -> PlacePhrase[Any]:
    """Build a place phrase of chunks and of the noun phrases that it relates to."""
    # words may have been brought into the order of the grammar from another
    place: PlacePhrase[Any] = PlacePhrase(
        how, min(child.start for child in children), max(child.end for child in children)
    )
    place.targets = tuple([child for child in children if not isinstance(child, Chunk)])
    for chunk in children:
        match chunk.type if isinstance(chunk, Chunk) else "":
            case "DIR":
                place.direction = chunk.value
            case "DIST":
                place.distance = chunk.value
            case "PART":
                place.part = chunk.value
            case "PREP" | "REL":
                place.word = chunk.value
            case "ON" | "IN" | "AT" | "TO":
                place.word = chunk.type
            case "MY" | "YOUR" | "ITS":
                place.owner = chunk.type
    return place


def negate(children: list[Any]) -> PlacePhrase[Any]:
    """Negate the place phrase behind a NOT."""
    place: PlacePhrase[Any] = children[1]
    place.negated = True
    return place


def build_with(build: Callable[..., Any], argument: str, rules: str) -> Builders:
    """Return a builder for each of some rules of a grammar, told the rule's name as an argument."""
    return {rule: partial(build, **{argument: rule}) for rule in rules.split()}


class IslandParser:
    """Parser by islands (LALR): chunks that the grammar does not expect are left out, or end an island.

    `grammar`, `start`: text and first rule of a grammar of lark; the terminals are types of chunks.
        The first rule becomes a `Clause`.
    `build`: called as soon as a rule is complete; see `Grammar`.
    `skipped`: types of chunks that may be left out where the grammar expects something else.
    """

    def __init__(self, grammar: str, start: str, build: Builders, skipped: Collection[str]) -> None:
        self._grammar = Grammar(grammar, start, build)
        self._skipped = skipped

    def parse(self, chunks: list[Chunk]) -> Iterator[tuple[Clause, list[Chunk]]]:
        """Parse the chunks of one clause.

        Yields
        ------
        clause, left_out
            Each clause, in order, and the chunks that had to be left out of it. A stretch that
            cannot be parsed is left out, and yields a clause without a verb.
        """
        while chunks:
            clause, left_out, used = self._island(chunks)
            island, chunks = chunks[:used], chunks[used:]
            if clause is None:
                clause, left_out = Clause(""), island
            parsed = [chunk for chunk in island if chunk not in left_out] or island
            clause.start, clause.end = min(c.start for c in parsed), max(c.end for c in parsed)
            yield clause, left_out

    def _island(self, chunks: list[Chunk]) -> tuple[Clause | None, list[Chunk], int]:
        """Return the longest clause from the first chunk on, chunks left out of it, and how many it took."""
        parse = self._grammar.parse()
        left_out: list[Chunk] = []
        for i, chunk in enumerate(chunks):
            try:
                parse.feed(chunk.type, chunk)
            except UnexpectedTokenError:
                if chunk.type in self._skipped:
                    left_out.append(chunk)
                    continue
                clause = _finish(parse)
                if clause is not None and i:
                    return clause, left_out, i
                return self._shorter(chunks[: i + 1], left_out)
        clause = _finish(parse)
        if clause is not None:
            return clause, left_out, len(chunks)
        return self._shorter(chunks, left_out)

    def _shorter(
        self, chunks: list[Chunk], left_out: list[Chunk]
    ) -> tuple[Clause | None, list[Chunk], int]:
        """Parse a beginning of chunks that cannot be parsed to their end."""
        used = [chunk for chunk in chunks if chunk not in left_out]
        for n in range(len(used) - 1, max(0, len(used) - 1 - _BACK), -1):
            parse = self._grammar.parse()
            try:
                for chunk in used[:n]:
                    parse.feed(chunk.type, chunk)
            except UnexpectedTokenError:
                continue
            clause = _finish(parse)
            if clause is not None:
                end = chunks.index(used[n])
                return clause, [chunk for chunk in left_out if chunk in chunks[:end]], end
        return None, left_out, len(chunks)


def _finish(parse: Parse) -> Clause | None:
    try:
        clause = parse.feed(END)
    except UnexpectedTokenError:
        return None
    return clause if isinstance(clause, Clause) else None


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

    `text`, `start`: the grammar and its first rule.
    `build`: by the name of each rule, or its alias, the function that is called with the children
        once the rule is complete. Rules whose names begin with an underscore have none: their
        children stand in for them.
    """

    def __init__(self, text: str, start: str, build: Builders) -> None:
        digest = sha256(f"1 {start} {text}".encode()).hexdigest()[:16]
        table = load_or_make(f"grammar-{digest}.json", lambda: _table(text, start), json.loads)
        self._states: list[dict[str, int]] = table["states"]
        self._first: int = table["start"]
        self._last: int = table["end"]
        self._rules = [
            _Rule(origin, len(inlined), inlined, single, build[name] if name else list)
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

        Raises `UnexpectedTokenError`: the grammar has no place for it; rules that were complete
        before it have been built.
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
    """Return JSON of the states: a token leads to another state (0 ...) or completes a rule (-1 ...)."""
    from lark import Lark
    from lark.grammar import Rule
    from lark.lexer import Lexer, TerminalDef

    class NoLexer(Lexer):
        def __init__(self, _conf: object) -> None: ...
        def lex(self, *_: object) -> Any: ...  # noqa: ANN401  # tokens come one by one

    lark = Lark(text, start=start, parser="lalr", lexer=NoLexer, maybe_placeholders=False)
    parts, memo = lark.memo_serialize([TerminalDef, Rule])
    table = parts["parser"]["parser"]
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
    """Return origin, name of what builds it, which symbols are inlined, whether one child stands alone."""
    origin, alias = rule["origin"]["name"], rule["alias"]
    inlined = [
        symbol["__type__"] == "NonTerminal" and symbol["name"].startswith("_")
        for symbol in rule["expansion"]
    ]
    single = rule["options"]["expand1"] and not alias
    unbuilt = origin.startswith("_") or (single and inlined == [False])
    return origin, alias or ("" if unbuilt else origin), inlined, single
