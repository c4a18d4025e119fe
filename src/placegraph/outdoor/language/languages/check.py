"""Whether a table is that of a language; what is wrong is named by file and field."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from placegraph.errors import InputError

if TYPE_CHECKING:
    _What = tuple[str, Callable[[Any], bool]]
    """What is wanted of a value, in words, and whether it is so."""

PHRASES = ("who", "determiners", "verbs", "prepositions", "joints", "plain", "after")
"""Sections whose keys are terminals of the grammar, one or several in a row."""
OWN = ("relations", "parts", "adverbs")
"""Sections with keys of their own."""
_MARKERS = ("GEN", "DROP", "UNSURE")
"""Terminals that only `order` and `settle` know."""
_ANGLES = frozenset(str(angle) for angle in range(0, 360, 45))
_SEE = "see docs/howto-language.md"


def _words(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(word, str) and word.strip() for word in value)


def _changes(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(change, str) and change.count(">") == 1 for change in value
    )


def _number(key: str) -> bool:
    return key.replace(".", "", 1).isdecimal() and float(key) > 0


_WORDS: _What = ('a list of phrases, as ["the"]', _words)
_CHANGES: _What = ('a list of changes, as ["kk>k"]', _changes)
_FLAG: _What = ("true or false", lambda value: isinstance(value, bool))
_TEXT: _What = ("a text", lambda value: isinstance(value, str) and bool(value))
_TABLES: _What = ("a list of tables", lambda value: isinstance(value, list))
_SINGLE: dict[str, _What] = {
    "name": _TEXT, "spaces": _FLAG, "capitals": _FLAG, "prefixes": _WORDS, "scripts": _WORDS,
    "examples": _TABLES,
}  # fmt: skip
_INNER: dict[tuple[str, str], _What] = {
    ("measures", "before"): _WORDS,
    ("forms", "nominative"): _WORDS,
    ("forms", "changes"): _CHANGES,
    ("forms", "irregular"): _CHANGES,
}
_NUMBERED = (("measures", "units"), ("measures", "numbers"))


def keys(table: Mapping[str, Any]) -> dict[str, frozenset[str]]:
    """Keys that the sections of another language may have: the words of those that English has."""
    found = {section: _parts(table, (section,)) for section in OWN}
    terminals = _parts(table, PHRASES) | set(_MARKERS)
    return found | dict.fromkeys((*PHRASES, "endings"), terminals) | {
        "order": frozenset(
            ("postpositions", "verb_final", "marked", "genitive", "head_first", "pro_drop", "cases",
             "verbless")
        )
    }  # fmt: skip


def _parts(table: Mapping[str, Any], sections: tuple[str, ...]) -> frozenset[str]:
    return frozenset(part for s in sections for key in table.get(s, {}) for part in key.split())


def checked(
    table: dict[str, Any], where: str, known: Mapping[str, frozenset[str]] | None
) -> dict[str, Any]:
    """Return the table of a language.

    Parameters
    ----------
    table, where
        What the file holds, and its path.
    known
        Keys by section (`keys`); None: any.

    Raises
    ------
    InputError
        If it is malformed; names the file, the field and what belongs there.
    """
    if "name" not in table:
        raise InputError(f"{where}: the field 'name' is missing; give the language's own name.")
    for section, value in table.items():
        if section in _SINGLE:
            _demand(value, _SINGLE[section], where, section)
        elif not isinstance(value, dict):
            raise InputError(f"{where}: the field {section!r} is no table; {_SEE}.")
        elif section in ("measures", "forms"):
            _nested(section, value, where, known or {})
        else:
            _section(section, value, where, known)
    return table


def _section(
    section: str,
    value: dict[str, Any],
    where: str,
    known: Mapping[str, frozenset[str]] | None,
) -> None:
    free = ("things", "lists", "say", "compass", "compass_short", "facing")
    if known is not None and section not in known and section not in free:
        raise InputError(f"{where}: there is no field {section!r}; {_SEE}.")
    for key, inner in value.items():
        angle, _, part = key.partition(" ")
        if section.startswith("compass") or section == "facing":
            of, _, whom = part.partition(" ")
            of_what = known is None or part in ("", "OF", "ME BE", *known["parts"])
            of_what = of_what or (known is not None and of == "OF" and whom in known["who"])
            right = angle in _ANGLES and of_what
            choice = ", ".join(sorted(_ANGLES))
        else:
            allowed = known.get(section) if known is not None else None
            others: frozenset[str] = frozenset()
            if known is not None and section in ("relations", "prepositions"):
                others = known["who"] | {"BE"}  # "dahinter", "yanındayım"
            right = allowed is None or (allowed | others).issuperset(key.split())
            choice = ", ".join(sorted(allowed or ()))
        if not key or not right:
            raise InputError(
                f"{where}: the key {key!r} of {section!r} is not known; choose from {choice}: {_SEE}."
            )
        flag = section == "order"
        if section != "say":
            _demand(inner, _FLAG if flag else _WORDS, where, f"{section}.{key}")


def _nested(
    section: str, value: dict[str, Any], where: str, known: Mapping[str, frozenset[str]]
) -> None:
    for key, inner in value.items():
        if (section, key) in _INNER:
            _demand(inner, _INNER[section, key], where, f"{section}.{key}")
            continue
        if (section, key) not in (*_NUMBERED, ("forms", "endings")):
            raise InputError(f"{where}: there is no field '{section}.{key}'; {_SEE}.")
        if not isinstance(inner, dict):
            raise InputError(f"{where}: the field '{section}.{key}' is no table; {_SEE}.")
        for name, words in inner.items():
            _demand(words, _WORDS, where, f"{section}.{key}.{name}")
            if key == "endings":
                right = known.get(key, frozenset()).issuperset(name.split())
            else:
                right = _number(name)
            if not right:
                raise InputError(
                    f"{where}: the key {name!r} of '{section}.{key}' is not known; {_SEE}."
                )


def _demand(value: object, what: _What, where: str, name: str) -> None:
    if not what[1](value):
        raise InputError(f"{where}: the field '{name}' is {value!r}; write {what[0]}.")
