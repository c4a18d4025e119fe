"""Which tags are worth naming: the rules of objects.tsv, applied to the tags of a thing."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeAlias

from placegraph.errors import InputError
from placegraph.outdoor.language.vocabulary.tables import find, rows
from placegraph.outdoor.language.vocabulary.text import normal, singular

COLUMNS = ("key", "values", "role", "rank", "with", "said")
OBJECT, KIND, DETAIL, SKIP = ROLES = ("object", "kind", "detail", "skip")

_VALUE = re.compile(r"[^\W_][\w:.+-]{0,39}")
"""A tag value that can be a label; free text ("The old mill, now closed") cannot."""

KIN = {
    "shop": ("shop", "amenity", "craft", "office", "leisure"),
    "office": ("office", "amenity", "healthcare", "craft"),
    "healthcare": ("healthcare", "amenity"),
    "craft": ("craft", "shop"),
}
"""Keys whose labels "x shop", "x office" ... may mean as well ("pharmacy shop")."""


class Rule(NamedTuple):
    """One row of objects.tsv, for one value."""

    role: str
    rank: int = 0
    needs: tuple[str, ...] = ()
    """Tags, ``key`` or ``key=value``, of which a thing must have one."""
    said: str = "{}"
    """How a value is said where no table has a better word."""


_Hit: TypeAlias = tuple[int, str, bool, tuple[str, ...]]
"""Rank, label, whether it makes an object, what a detail needs."""


class _Values(dict[str, tuple[_Hit, ...]]):
    """Labels of every value of one key met so far; a new value is looked up in the rules once."""

    def __init__(self, key: str, rules: Mapping[str, Rule], common: Mapping[str, Rule]) -> None:
        self.key, self.rules, self.common = key, rules, common

    def __missing__(self, text: str) -> tuple[_Hit, ...]:
        hits = tuple(dict.fromkeys(hit for part in text.split(";") for hit in self._hit(part)))
        self[text] = hits
        return hits

    def _hit(self, text: str) -> tuple[_Hit, ...]:
        value = "_".join(text.lower().split())
        rule = self.rules.get(value) or self.common.get(value) or self.rules.get("*")
        if not value or rule is None or rule.role == SKIP:
            return ()
        if not _VALUE.fullmatch(value):
            if rule.role != OBJECT:
                return ()
            value = "yes"  # a shop of a kind told in free text is still a shop
        return ((rule.rank, f"{self.key}={value}", rule.role == OBJECT, rule.needs),)


class ObjectTable:
    """The rules of objects.tsv.

    Attributes
    ----------
    keys
        Keys that can make an object: what a reader needs to look at.
    detail_keys
        Keys that only add labels to an object.
    """

    def __init__(self, rules: Mapping[str, Mapping[str, Rule]]) -> None:
        common = rules.get("*", {})
        own = {key: values for key, values in rules.items() if key != "*"}
        roles = {key: {rule.role for rule in values.values()} for key, values in own.items()}
        self.keys = frozenset(key for key in own if OBJECT in roles[key])
        self.detail_keys = frozenset(key for key in own if roles[key] & {KIND, DETAIL}) - self.keys
        self._rules, self._common = own, common
        self._values = {key: _Values(key, values, common) for key, values in own.items()}

    def labels_of(self, tags: Mapping[str, str]) -> tuple[str, ...]:
        """Labels ``key=value`` of a tagged thing, most specific first; none if it is no object."""
        known = self._values
        hits: list[_Hit] = []
        for key in tags:
            if key in known:
                hits += known[key][tags[key]]
        if len(hits) == 1:
            return (hits[0][1],) if hits[0][2] else ()
        if not any(hit[2] for hit in hits):
            return ()
        hits.sort()
        return tuple([label for _, label, _, needs in hits if not needs or _any(needs, tags)])

    def names(self, label: str) -> bool:
        """Tell whether a label (also ``key=*``) can be one of a thing's labels."""
        key, _, value = label.partition("=")
        if value == "*":
            return key in self.keys or key in self.detail_keys
        return key in self._values and any(hit[1] == label for hit in self._values[key][value])

    def rule(self, label: str) -> Rule:
        """Return the rule that a nameable label falls under."""
        key, _, value = label.partition("=")
        values = self._rules[key]
        return values.get(value) or values.get("*") or next(iter(values.values()))

    def listed(self) -> list[str]:
        """Labels of objects and kinds that have a row of their own."""
        return [
            f"{key}={value}"
            for key, values in self._rules.items()
            for value, rule in values.items()
            if value != "*" and rule.role in (OBJECT, KIND)
        ]

    @cached_property
    def undrawn(self) -> frozenset[str]:
        """Values, in normal form, that are words for things no map draws: skipped, but said."""
        everywhere = [self._common, *self._rules.values()]
        skipped = [(v, r.said) for rules in everywhere for v, r in rules.items() if r.role == SKIP]
        return frozenset(singular(normal(value)) for value, said in skipped if said != "{}")

    def by_rank(self, found: Mapping[str, float]) -> dict[str, float]:
        """Nameable labels, those of specific keys first."""
        known = [label for label in found if self.names(label)]
        known.sort(key=lambda label: self.rule(label).rank)
        return {label: found[label] for label in known}

    def built(self, form: str) -> Iterator[tuple[str, str]]:
        """Key and value of a phrase by the way it is built: "kite shop" is ``shop``, "kite"."""
        for key, pattern in self._patterns:
            if match := pattern.fullmatch(form):
                yield key, match[1]

    @cached_property
    def _patterns(self) -> tuple[tuple[str, re.Pattern[str]], ...]:
        """How unlisted values are said ("0 shop"), as expressions, by key."""
        said = [
            (key, normal(values["*"].said.replace("{}", " 0 ")))
            for key, values in self._rules.items()
            if "*" in values and values["*"].said != "{}"
        ]
        said.append(("shop", "0 store"))
        return tuple((key, re.compile(pattern.replace("0", "(.+)", 1))) for key, pattern in said)


def _any(needs: tuple[str, ...], tags: Mapping[str, str]) -> bool:
    for need in needs:
        key, _, value = need.partition("=")
        if key in tags and (not value or value in tags[key].split(";")):
            return True
    return False


def read_objects(folder: Path | None = None) -> ObjectTable:
    """Read objects.tsv from `folder`, or as shipped.

    Raises
    ------
    InputError
        Naming file, line and field of what is wrong.
    """
    table = find("objects.tsv", folder)
    rules: dict[str, dict[str, Rule]] = {}
    for number, (key, values, *fields) in rows(table, COLUMNS):
        where = f"{table}, line {number}"
        if not key or not values:
            raise InputError(f"{where}: the fields 'key' and 'values' must not be empty.")
        rule = _read_rule(where, key, *fields)
        known = rules.setdefault(key, {})
        for value in values.split():
            if value in known:
                raise InputError(f"{where}: {key}={value} has a row already; keep one of the two.")
            known[value] = rule
    if not any(rule.role == OBJECT for values in rules.values() for rule in values.values()):
        raise InputError(f"{table}: has no row with the role 'object'; nothing could be named.")
    return ObjectTable(rules)


def _read_rule(where: str, key: str, role: str, rank: str, needs: str, said: str) -> Rule:
    if role not in ROLES:
        raise InputError(f"{where}: the field 'role' is {role!r}; write {', '.join(ROLES)}.")
    if key == "*" and role != SKIP:
        raise InputError(f"{where}: a row over every key ('key' is *) can only be a skip.")
    if role != SKIP and not (rank.isascii() and rank.isdigit()):
        raise InputError(f"{where}: the field 'rank' is {rank!r}; write a whole number.")
    if needs and role not in (KIND, DETAIL):
        raise InputError(
            f"{where}: only a kind or detail can have the field 'with'; it is {needs!r}."
        )
    if said.count("{}") != bool(said):
        raise InputError(f"{where}: the field 'said' is {said!r}; write {{}} once in it.")
    return Rule(role, int(rank or 0), tuple(needs.split()), said or "{}")
