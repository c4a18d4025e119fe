"""Sites that people name by streets: crossings, blocks between crossings, and house numbers."""

from __future__ import annotations

import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.language.words import (
    BETWEEN,
    COMPASS,
    CORNERS,
    JOINS,
    PLURALS,
    SIDES,
    SMALL,
    TYPES,
    fold,
    ordinal,
)
from placegraph.outdoor.map.objects import LINE, CityObjects, Lines, join

STEP = 8.0
"""Streets are sampled in steps of this length [m]."""
CROSSING = 16.0
"""Two streets cross where samples are nearer than this [m]."""
APART = 60.0
"""Crossings of two streets nearer than this are one, such as those of two carriageways [m]."""
MAX_SITES = 6
"""Words that stand for more places than this stand for none."""
MAX_KEPT = 10_000
"""Largest number of sites that are kept for later texts."""
MAX_GAP = 400
"""Largest difference of house numbers between which one is interpolated."""
NEIGHBOURS, SURE_NUMBER = 800.0, 40.0
"""Reach of numbers of parallel streets, and error of a house number told from them [m]."""
LONGEST = 5
"""Words of the longest street name that is looked for."""
_OF = BETWEEN | {"of", "de", "del", "der", "da", "du", "di", "van", fold("av")}
"""Words between "corner" and the first of two streets."""
_FILL = JOINS | CORNERS | _OF | {",", "the", "with", "st", "a", "la"}
_TOKEN = re.compile(r"[^\W_]+(?:['’`´][^\W_]+)*|[&@/,;:()]|[.](?=\s|$)|\s--?\s|-|\n")
_NUMBER = re.compile(r"\d{1,5}")
_NOWHERE = np.zeros((0, 2))


class Site(NamedTuple):
    """A stretch of a text that names a place by its streets."""

    start: int
    end: int
    positions: Floats
    """(K, 2) east, north [m] of the places that it may mean."""


class _Token(NamedTuple):
    word: str
    """Normal form, as of names."""
    start: int
    end: int
    capital: bool


class _StreetMatch(NamedTuple):
    """A street in a text: its tokens and what it may be."""

    first: int
    last: int
    streets: tuple[int, ...]
    exact: bool
    """Whether a street bears the words as its whole name."""
    typed: bool
    """Whether the words say that it is a street."""


@dataclass(eq=False)
class Streets:
    """Streets of a map by what people call them, with their crossings and house numbers."""

    objects: CityObjects
    samples: dict[int, tuple[Floats, Floats]] = field(default_factory=dict)
    """Points (K, 2) [m] of streets that were asked for, and their directions there."""
    sites: dict[tuple[object, ...], Floats] = field(default_factory=dict)

    @cached_property
    def _rows(self) -> list[list[int]]:
        """Rows of objects of each street."""
        o = self.objects
        road = np.array([label.startswith("highway=") for label in o.labels])
        hits = np.concatenate(([0], np.cumsum(road[o.label_values])))
        lines = (o.kind == LINE) & (hits[o.label_starts[1:]] > hits[o.label_starts[:-1]])
        rows: dict[str, list[int]] = {}
        for row in np.flatnonzero(lines & (np.diff(o.name_starts) > 0)).tolist():
            for value in o.name_values[o.name_starts[row] : o.name_starts[row + 1]].tolist():
                rows.setdefault(" ".join(_tokens(o.names[value])), []).append(row)
        self._names = [name for name in rows if name]
        return [rows[name] for name in self._names]

    @cached_property
    def _forms(self) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
        """Streets by their whole names, and by what is left without a type or a point of the compass."""
        loose: dict[str, list[int]] = {}
        rows = self._rows
        exact = {name: [i] for i, name in enumerate(self._names)}
        for i in range(len(rows)):
            for form in _list_short_forms(self._names[i].split()):
                loose.setdefault(" ".join(form), []).append(i)
        loose.pop("the", None)  # of "The Crescent"
        return exact, loose

    def find_sites(self, text: str) -> list[Site]:
        """Find what names a place by streets: "NE corner of Main St & W 10th Ave", "15 E Hastings"."""
        if not any(c.isdigit() or c in "&@/" for c in text) and not _HINT.search(text):
            return []
        tokens = list(_scan(text))
        streets = list(self._find_streets(tokens))
        found: list[Site] = []
        taken = -1
        for k, street in enumerate(streets):
            if street.first <= taken:
                continue
            site, last = self._read_site(tokens, streets, k)
            if site is not None:
                found.append(site)
                taken = last
        return found

    def resolve(self, words: str) -> Floats:
        """Return the places (K, 2) [m] that words of one site mean; none for other words."""
        sites = self.find_sites(words)
        whole = len(sites) == 1 and sites[0].end >= len(words.rstrip(" ."))
        return sites[0].positions if whole else _NOWHERE

    def _find_streets(self, tokens: list[_Token]) -> Iterator[_StreetMatch]:
        """Yield streets in a text, the longest name at each word."""
        exact, loose = self._forms
        i = 0
        while i < len(tokens):
            step = 1
            for n in range(min(LONGEST, len(tokens) - i), 0, -1):
                words = [token.word for token in tokens[i : i + n]]
                key = _join_ordinals(words)
                ids = exact.get(key, []), loose.get(key, [])
                if not (ids[0] or ids[1]):
                    continue
                typed = any(word in TYPES for word in words) and n > 1
                last = i + n - 1
                following = tokens[last + 1] if last + 1 < len(tokens) else None
                if not typed and following is not None and _continues(tokens[last], following):
                    continue  # "Hudson Yards" is another place than Hudson Street
                yield _StreetMatch(i, last, (*ids[0], *ids[1]), bool(ids[0]), typed)
                step = last + 1 - i
                break
            i += step

    def _read_site(
        self, tokens: list[_Token], streets: list[_StreetMatch], k: int
    ) -> tuple[Site | None, int]:
        """Read the site that begins with a street; return it and its last token."""
        one = streets[k]
        before = tokens[one.first - 1].word if one.first else ""
        following = streets[k + 1] if k + 1 < len(streets) else None
        if _NUMBER.fullmatch(before):
            at = self.find_address(int(before), one.streets)
            if len(at):
                return _site(tokens, one.first - 1, one.last, at), one.last
        after = [token.word for token in tokens[one.last + 1 : one.last + 3]]
        if after and _NUMBER.fullmatch(after[0]) and not after[-1][:1].isalpha():  # "Hauptstr. 12"
            at = self.find_address(int(after[0]), one.streets, grid=False)
            if len(at):
                return _site(tokens, one.first, one.last + 1, at), one.last + 1
        first, side = _find_end(tokens, one.first)
        if first < one.first and (one.typed or one.exact or tokens[one.first].capital):
            at = self.find_ends(one.streets, side)
            return (_site(tokens, first, one.last, at), one.last) if len(at) else (None, -1)
        if following is None:
            return None, -1
        gap = [token.word for token in tokens[one.last + 1 : following.first]]
        if k + 2 < len(streets):
            site = self._read_block(tokens, one, following, streets[k + 2])
            if site is not None:
                return site, streets[k + 2].last
        first = _find_lead(tokens, one.first)
        led = first < one.first
        if (before in BETWEEN and not led) or not (_joins(gap) or (led and gap == [fold("e")])):
            return None, -1
        led = led or _is_led(tokens, one.first, one.last + 1) or before in _OPENS
        named = one.typed or following.typed or one.exact or following.exact
        at = self.find_crossings(one.streets, following.streets) if led or named else _NOWHERE
        return (_site(tokens, first, following.last, at), following.last) if len(at) else (None, -1)

    def _read_block(
        self, tokens: list[_Token], one: _StreetMatch, two: _StreetMatch, three: _StreetMatch
    ) -> Site | None:
        """Read "Main between 5th and 6th", or "between 5th and 6th on Main"."""
        before = tokens[one.first - 1].word if one.first else ""
        gaps = [
            [token.word for token in tokens[a.last + 1 : b.first]]
            for a, b in ((one, two), (two, three))
        ]
        if len(gaps[0]) <= 4 and not BETWEEN.isdisjoint(gaps[0]) and _joins(gaps[1]):
            at, first = self.find_block(one.streets, two.streets, three.streets), one.first
        elif before in BETWEEN and _joins(gaps[0]) and gaps[1] in (["on"], ["along"], ["in"]):
            at, first = self.find_block(three.streets, one.streets, two.streets), one.first - 1
        else:
            return None
        return _site(tokens, first, three.last, at) if len(at) else None

    def find_crossings(self, one: Sequence[int], other: Sequence[int]) -> Floats:
        """Find where one of some streets crosses one of others: (K, 2) [m]; none if too many."""
        key = (tuple(one), tuple(other))
        at = self.sites.get(key)
        if at is None:
            found = [
                self._cross(a, b) for a in one[:MAX_SITES] for b in other[:MAX_SITES] if a != b
            ]
            at = _merge(np.concatenate([_NOWHERE, *found]))
            at = self._keep(key, at if len(at) <= MAX_SITES else at[:0])
        return at

    def find_ends(self, streets: Sequence[int], side: str) -> Floats:
        """Find the ends (K, 2) [m] of streets, or those to a side: "east"; none if too many."""
        towards = [(a in side) - (b in side) for a, b in (("east", "west"), ("north", "south"))]
        found: list[Floats] = []
        for street in streets[:MAX_SITES]:
            points = self._sample(street)[0]
            one = points[np.argmax(np.hypot(*(points - points.mean(axis=0)).T))]
            both = one, points[np.argmax(np.hypot(*(points - one).T))]
            found += [points[np.argmax(points @ towards)]] if side else both
        return np.array(found if len(found) <= MAX_SITES else []).reshape(-1, 2)

    def find_block(self, street: Sequence[int], one: Sequence[int], other: Sequence[int]) -> Floats:
        """Find the places (K, 2) [m] on a street between its crossings with two others."""
        a, b = self.find_crossings(street, one), self.find_crossings(street, other)
        if not (len(a) and len(b)):
            return _NOWHERE
        apart = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))
        i, j = np.unravel_index(np.argmin(apart), apart.shape)
        shares = np.array([[0.25], [0.5], [0.75]])
        return np.asarray(a[i] + shares * (b[j] - a[i]))

    def find_address(self, number: int, streets: Sequence[int], *, grid: bool = True) -> Floats:
        """Find the places (K, 2) [m] of a house number: as mapped, else between its neighbours.

        Else parallel streets tell it where they are numbered alike (`grid`).
        """
        key = ("number", number, tuple(streets), grid)
        at = self.sites.get(key)
        if at is None:
            found = [self._place_number(number, street, grid) for street in streets[:MAX_SITES]]
            sure = [at for at, rank in found if rank == 2] or [at for at, rank in found if rank]
            at = self._keep(key, _merge(np.concatenate([_NOWHERE, *sure]))[:MAX_SITES])
        return at

    def _keep(self, key: tuple[object, ...], at: Floats) -> Floats:
        """Keep places (K, 2) [m] for later texts, of at most `MAX_KEPT` sites: texts may name any number."""
        if len(self.sites) >= MAX_KEPT:
            self.sites.clear()
        self.sites[key] = at
        return at

    def _place_number(self, number: int, street: int, grid: bool) -> tuple[Floats, int]:
        """Return the place (K, 2) [m] of a number on a street; 2 as mapped, 1 interpolated, 0 none."""
        known = self._numbers.get(self._names[street])
        if known is not None:
            numbers, at = known
            i = bisect_left(numbers, number)
            if (end := bisect_right(numbers, number)) > i:
                return at[i:end], 2  # streets of one name in several towns
            gap = numbers[i] - numbers[i - 1] if 0 < i < len(numbers) else MAX_GAP + 1
            if gap <= MAX_GAP and np.hypot(*(at[i] - at[i - 1])) < NEIGHBOURS:
                share = (number - numbers[i - 1]) / gap
                points, place = self._sample(street)[0], at[i - 1] + share * (at[i] - at[i - 1])
                return points[np.argmin(np.hypot(*(points - place).T))][None], 1
        return self._tell_by_parallels(number, street) if grid else (_NOWHERE, 0)

    def _tell_by_parallels(self, number: int, street: int) -> tuple[Floats, int]:
        """Tell where a number lies on a street by the numbers of parallel streets, as in a grid."""
        points, step = (of[::3] for of in self._sample(street))
        places, numbers, along = self._all_numbers
        if not len(places):
            return places, 0
        beside = points.min(axis=0) - NEIGHBOURS, points.max(axis=0) + NEIGHBOURS
        near = ((places >= beside[0]) & (places <= beside[1])).all(axis=1)
        delta = places[near][None] - points[:, None]
        ahead = np.abs((delta * step[:, None]).sum(axis=2))
        aside = np.abs(delta[..., 0] * step[:, None, 1] - delta[..., 1] * step[:, None, 0])
        weight = np.exp(-ahead / 25.0 - aside / 200.0)
        weight *= (np.abs(step @ along[near].T) > 0.95) & (aside < NEIGHBOURS)
        total = weight.sum(axis=1)
        usable = total > 1e-4
        if not usable.any():
            return points[:0], 0
        told = weight[usable] @ numbers[near] / total[usable]
        best = int(np.argmin(np.abs(told - number)))
        if abs(told[best] - number) > SURE_NUMBER:
            return points[:0], 0
        return points[usable][best : best + 1], 1

    @cached_property
    def _numbers(self) -> dict[str, tuple[list[int], Floats]]:
        """House numbers of each street, ascending, and their places (K, 2) [m]: one or more of each."""
        o = self.objects
        address = {}
        for value, name in enumerate(o.names):
            first, _, rest = name.partition(" ")
            if _NUMBER.fullmatch(first) and rest:
                address[value] = (" ".join(_tokens(rest)), int(first))
        which = np.isin(o.name_values, list(address))
        rows = np.searchsorted(o.name_starts, np.flatnonzero(which), "right") - 1
        found: dict[str, dict[int, list[int]]] = {}
        for row, value in zip(rows.tolist(), o.name_values[which].tolist(), strict=True):
            street, number = address[value]
            found.setdefault(street, {}).setdefault(number, []).append(row)
        placed = {
            street: [
                (n, at) for n in sorted(of) for at in _merge(o.center[of[n]].astype(np.float64))
            ]
            for street, of in found.items()
        }
        return {
            street: ([n for n, _ in of], np.array([at for _, at in of]))
            for street, of in placed.items()
        }

    @cached_property
    def _all_numbers(self) -> tuple[Floats, Floats, Floats]:
        """Places (A, 2) [m], numbers (A,) and directions (A, 2) of the streets of all houses."""
        places, numbers, along = [np.zeros((0, 2))], [np.zeros(0)], [np.zeros((0, 2))]
        ids = {name: i for i, name in enumerate(self._names)} if self._rows else {}
        for name, (of, at) in self._numbers.items():
            if name not in ids:
                continue
            points, step = self._sample(ids[name])
            near = np.hypot(*(at[:, None] - points[None]).transpose(2, 0, 1)).argmin(axis=1)
            along.append(step[near])
            places.append(at)
            numbers.append(np.array(of, np.float64))
        return np.concatenate(places), np.concatenate(numbers), np.concatenate(along)

    def _sample(self, street: int) -> tuple[Floats, Floats]:
        """Sample points (K, 2) [m] along a street, and unit vectors of its direction there."""
        if street not in self.samples:
            rows = np.array(self._rows[street])
            _, points, ahead = Lines.of_objects(self.objects, rows).sample(STEP)
            length = np.maximum(np.hypot(*ahead.T), 1e-9)
            self.samples[street] = points, ahead / length[:, None]
        return self.samples[street]

    def _cross(self, one: int, other: int) -> Floats:
        """Return where two streets cross (K, 2) [m]: where samples of both are close."""
        a, b = self._sample(one)[0], self._sample(other)[0]
        i, j = join(a, b, CROSSING)
        return _merge(0.5 * (a[i] + b[j]))


_ENDS = frozenset(("end", "terminus", "foot", "beginning", "start", "head"))
_HINT = re.compile(
    rf"\b(?:{'|'.join(word for word in JOINS | CORNERS | BETWEEN | _ENDS if word.isalpha())})\b",
    re.IGNORECASE,
)


def _tokens(name: str) -> list[str]:
    """Return the words of a name in normal form."""
    return _join_ordinals([t.word for t in _scan(name) if t.word[0].isalnum()]).split()


def _scan(text: str) -> Iterator[_Token]:
    """Yield words and marks of a text; a full stop that shortens a word is none."""
    last = ""
    for match in _TOKEN.finditer(text):
        written = match.group()
        if written == "." and len(last) < 5 and last.isalpha():
            continue
        word = fold(written) if written[0].isalnum() else written.strip() or "\n"
        word = PLURALS.get(word, word)
        last = written
        yield _Token(word or written, match.start(), match.end(), written[0].isupper())


def _continues(token: _Token, following: _Token) -> bool:
    """Tell whether a name goes on with the next word."""
    beside = following.start - token.end == 1 and following.word not in TYPES | COMPASS
    return beside and following.capital and following.word.isalpha()


def _join_ordinals(words: Sequence[str]) -> str:
    """Join words of a street; "East 40 St" is counted: "east 40th st"."""
    found = list(words)
    for i, word in enumerate(found[1:]):
        if word in ("st", "ave") and found[i].isdecimal() and len(found[i]) < 4:
            found[i] = ordinal(int(found[i]))
    return " ".join(found)


def _list_short_forms(words: list[str]) -> Iterator[list[str]]:
    """Yield what a street is called without its type, without a point of the compass, or either."""
    bare = list(words)
    if len(bare) > 1 and bare[0] in COMPASS:
        bare = bare[1:]
    if len(bare) > 1 and bare[-1] in COMPASS:
        bare = bare[:-1]
    untyped = [list(words), bare]
    for form in untyped:
        if form != words:
            yield form
        if len(form) > 1 and form[-1] in TYPES and not (len(form) == 2 and form[0] in COMPASS):
            yield form[:-1]
        elif len(form) > 1 and form[0] in TYPES:
            rest = form[1:]
            while len(rest) > 1 and rest[0] in SMALL:
                rest = rest[1:]
            yield rest


def _joins(words: Sequence[str]) -> bool:
    """Tell whether words between two streets say that these cross."""
    return 0 < len(words) <= 5 and all(w in _FILL for w in words) and not JOINS.isdisjoint(words)


def _is_led(tokens: list[_Token], first: int, end: int) -> bool:
    """Tell whether marks or words beside a name in small letters say that it is a street."""
    before = tokens[first - 1].word if first else ""
    after = tokens[end].word if end < len(tokens) else ""
    led = first > 1 and before in _OF and tokens[first - 2].word in CORNERS
    return led or before in ("@", "/", "&") or after in ("@", "/", "&")


def _find_lead(tokens: list[_Token], first: int) -> int:
    """Return where "(the) NE corner of" before a street begins; the street itself without it."""
    i = first - 1
    if i >= 0 and tokens[i].word == "the":
        i -= 1
    if i < 1 or tokens[i].word not in _OF or tokens[i - 1].word not in CORNERS:
        return first if i < 0 or tokens[i].word not in CORNERS else i
    i -= 1
    while i > 0 and tokens[i - 1].word in SIDES:
        i -= 1
    return i - 1 if i > 0 and tokens[i - 1].word in ("the", "a") else i


def _find_end(tokens: list[_Token], first: int) -> tuple[int, str]:
    """Return where "the east end of" before a street begins, and the side; the street without it."""
    if first < 2 or tokens[first - 1].word != "of" or tokens[first - 2].word not in _ENDS:
        return first, ""
    first -= 2
    side = tokens[first - 1].word.removesuffix("ern") if first else ""
    first -= side in COMPASS
    return first - (first > 0 and tokens[first - 1].word == "the"), side if side in COMPASS else ""


_OPENS = frozenset(("", ".", ";", ":", "-", "(", "\n", ",", "at", "on", "of", "and", "near", "by"))
"""Words and marks before two streets that cross."""


def _site(tokens: list[_Token], first: int, last: int, at: Floats) -> Site:
    return Site(tokens[first].start, tokens[last].end, at)


def _merge(points: Floats) -> Floats:
    """Merge points (K, 2) [m] nearer than `APART` to the first of them to their mean."""
    found = []
    while len(points):
        near = np.hypot(*(points - points[0]).T) < APART
        found.append(points[near].mean(axis=0))
        points = points[~near]
    return np.array(found).reshape(-1, 2)
