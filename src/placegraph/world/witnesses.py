"""What words and a fix say of each scene, before any frame is looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.indoor.map.floor import storeys
from placegraph.outdoor.language.description import SPEAKER, WITHIN
from placegraph.outdoor.language.words import tokens
from placegraph.world.floors import ratio_of
from placegraph.world.inside import Inside, things_of
from placegraph.world.split import Understood, understand
from placegraph.world.standing import UNANCHORED, Standing

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate
    from placegraph.world.among import Others
    from placegraph.world.floors import Floor
    from placegraph.world.known import Known
    from placegraph.world.outside import Outside, Told
    from placegraph.world.world import World


CALLED = 3.0
"""What it says for a scene that its name, or its building's, was spoken [nat]."""


@dataclass(frozen=True, eq=False)
class Witness:
    """What is known of being in one scene."""

    name: str
    standings: tuple[Standing, ...] = ()
    """Candidates of its place, the likeliest first, after all that was said."""
    shares: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    """(K,) probability of each."""
    outside: float = 0.0
    """Log-likelihood ratio of what was said of the outside [nat], against anywhere."""
    inside: float = 0.0
    """The same of the inside."""
    near: float = 1.0
    """How well it fits the fix, 0 to 1."""
    meant: bool = False
    """Whether its building, or the scene itself, was spoken of by name or kind."""
    told: Told | None = None
    """What the city that it stands in says of it, if anything was said of that."""
    floors: tuple[Floor, ...] = ()
    """Floors that the speaker was said to be on."""
    above: int = 0
    """Storeys above the level of the anchor."""

    @property
    def said(self) -> float:
        """What words say for it [nat]."""
        return self.outside + self.inside

    @property
    def building(self) -> str:
        """Name of its building, where that is known."""
        return self.standings[0].anchor.building if self.standings else ""


@dataclass(frozen=True, eq=False)
class Witnesses:
    """What words and a fix say of all scenes and towns."""

    understood: Understood | None
    towns: dict[str, Outside]
    inside: Inside | None
    scenes: dict[str, Witness]
    near: tuple[float, float] | None = None
    others: Others | None = None
    """What the scenes hold that are not among these, where there are many."""
    mute: str = ""
    """Why nothing that was said can be looked for outdoors."""

    @property
    def parts(self) -> dict[str, CityEstimate]:
        """What each town says of the outside."""
        return {name: part for town in self.towns.values() for name, part in town.parts.items()}

    @property
    def speaks_inside(self) -> bool:
        """Whether somebody inside a mapped scene seems to speak."""
        return (
            self.inside is not None
            or any(w.meant for w in self.scenes.values())
            or (self.understood is not None and bool(self.understood.floors))
        )

    def prior(self, name: str) -> float:
        """Share of a scene among all, by the fix alone; together at most 1."""
        return self.scenes[name].near / self.crowded

    @property
    def crowded(self) -> float:
        """What shares are of: how many scenes there are, so far as they fit the fix."""
        total = self.others.near if self.others else sum(w.near for w in self.scenes.values())
        return total if self.near is None else max(1.0, total)

    def evidence(self, name: str) -> tuple[Evidence, ...]:
        """What each statement, and the fix, say of a scene."""
        w = self.scenes[name]
        out: list[Evidence] = []
        if w.told is not None:
            out += w.told.evidence
        if self.inside is not None:
            out += self.inside.evidence(name)
        if w.standings:
            out += [floor.evidence(w.standings[0].anchor.level, w.above) for floor in w.floors]
        if self.near is not None and w.standings:
            weight = float(np.log(w.near / 0.5))
            verdict = "for" if weight > 0 else "against"
            out.append(Evidence("the fix is near", verdict, weight))
        return tuple(out)


@dataclass(frozen=True)
class Heard:
    """What was said, and what the towns make of it."""

    understood: Understood | None = None
    towns: dict[str, Outside] = field(default_factory=dict)
    mute: str = ""
    """Why no town makes anything of it."""


def said(world: World, known: Known) -> Heard:
    """What a text says of towns; raises as `World.locate`."""
    if known.text is None:
        return Heard()
    things: tuple[str, ...]
    if world.crowd is not None:
        things, names = world.crowd.things, world.crowd.names(known.text)
    else:
        things = things_of(world.library) if world.scenes else ()
        stands = (s for scene in world.scenes.values() for s in Standing.of(scene))
        names = {*world.scenes, *(s.anchor.building for s in stands)} - {""}
    towns = world.towns
    understood = understand(known.text, towns, things, known.heading, names, known.language)
    heard: dict[str, Outside] = {}
    mute: dict[str, None] = {}
    for name, outside in understood.outside.items():
        told = towns[name].hear(outside, known)
        if isinstance(told, str):
            mute[told] = None
        else:
            heard[name] = told
    return Heard(understood, heard, " ".join(filter(None, mute)))


def hear(world: World, known: Known, heard: Heard) -> Witnesses:
    """What is known of all scenes and towns but for the frames; raises as `World.locate`."""
    scenes = {name: Standing.of(world.scenes[name]) for name in world.scenes}
    understood, towns, inside = heard.understood, heard.towns, None
    if understood is not None and understood.inside is not None and scenes:
        inside = Inside.hear(world.library, understood.inside)
    floors = understood.floors if understood else ()
    above = {n: len(storeys(world.scenes[n], 0)) - 1 if floors else 0 for n in scenes}
    spoken = f" {' '.join(tokens(known.text or ''))} "
    refused = [f" {' '.join(tokens(name))} " for name in _denied(understood)]
    for name in refused:
        spoken = spoken.replace(name, " | ")
    denied = "|".join(refused)
    judge = _Judge(known, floors, inside, spoken, denied)
    near = None if known.near is None else (float(known.near[0]), float(known.near[1]))
    told = iter(_told([s for standings in scenes.values() for s in standings], towns))
    found = {n: judge.witness(n, s, [next(told) for _ in s], above[n]) for n, s in scenes.items()}
    return Witnesses(understood, towns, inside, found, near, world.others, heard.mute)


@dataclass(frozen=True, eq=False)
class _Judge:
    """What was said, by who can judge it."""

    known: Known
    floors: tuple[Floor, ...]
    inside: Inside | None
    spoken: str
    """All words, but for those that deny."""
    denied: str
    """Names that the speaker is not in."""

    def witness(
        self, name: str, standings: tuple[Standing, ...], told: Sequence[Told | None], above: int
    ) -> Witness:
        """What they, and towns, say of one scene and the candidates of its place."""
        names = {name, *(s.anchor.building for s in standings)}
        called = any(_called(n, self.spoken) for n in names)
        refused = CALLED * any(_called(n, self.denied) for n in names)
        said = self.inside.scenes[name] if self.inside else 0.0
        if not standings:
            fits = 1.0 if self.known.near is None else UNANCHORED
            return Witness(
                name, outside=CALLED * called - refused, inside=said, near=fits, meant=called
            )
        priors = np.array([s.there.probability for s in standings])
        ratios = np.array([t.judged.ratio if t else 0.0 for t in told])
        ratios += [ratio_of(self.floors, s.anchor.level, above) for s in standings]
        nears = np.ones(len(standings))
        if self.known.near is not None:
            nears = np.array([s.near(self.known.near, self.known.radius) for s in standings])
        logs = np.log(priors) + ratios + np.log(nears)
        shares = np.exp(logs - logs.max())
        shares /= shares.sum()
        order = np.argsort(-shares, kind="stable")
        best = int(order[0])
        unknown = max(0.0, 1.0 - float(priors.sum()))
        outside = float(np.log(priors @ np.exp(ratios) + unknown))
        return Witness(
            name,
            tuple(standings[i] for i in order),
            shares[order],
            outside + CALLED * (called and told[best] is None) - refused,
            said,
            float(priors @ nears + unknown * UNANCHORED),
            called or any(t is not None and t.judged.meant for t in told),
            told[best],
            self.floors,
            above,
        )  # fmt: skip


def _told(standings: Sequence[Standing], towns: dict[str, Outside]) -> list[Told | None]:
    """What the town that each candidate stands in says of it."""
    out: list[Told | None] = [None] * len(standings)
    for town in towns.values():
        left = [k for k, told in enumerate(out) if told is None]
        for k, told in zip(
            left, town.of_buildings([standings[k].corners for k in left]), strict=True
        ):
            out[k] = told
    return out


def _denied(understood: Understood | None) -> tuple[str, ...]:
    """Names of what the speaker was said not to be in: "I am not in the Grand Hotel"."""
    said = understood.outside.values() if understood else ()
    return tuple(dict.fromkeys(
        d.mentions[s.target].name
        for d in said for s in d.statements
        if d.mentions[s.target].name and s.negated and s.source == SPEAKER
        and s.relation in WITHIN
    ))  # fmt: skip


def _called(name: str, spoken: str) -> bool:
    """Whether a name was spoken."""
    said = " ".join(tokens(name))
    return len(said) > 3 and f" {said} " in spoken
