"""Locating in a world: one posterior over place, room and pose, from text, frames and a location prior.

Somebody who speaks of rooms is probably in one that is mapped (`PRIOR_MAPPED`); else in another building of
a town, or in none of these towns. Statements about the outside tell both apart. Where there are frames,
scenes are proposed by them and by all else; then poses are sought in the likeliest, one by one, and the
odds of each add to what is known of its scene.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import Evidence, Place, PoseEstimate, PoseMode, SceneEstimate, Status
from placegraph.core.geometry import angle_between
from placegraph.errors import OptionError
from placegraph.indoor.library.localize import defer_colourless, localize_in_scenes
from placegraph.indoor.library.search import SearchOptions, infer_from_frames
from placegraph.indoor.map.floor import find_storey
from placegraph.indoor.map.rooms import find_room_name
from placegraph.indoor.pose.window import chosen_frames
from placegraph.indoor.status import choose_scene, doubt_by_search, fit_odds, scene_of, search_odds
from placegraph.outdoor.language.description import SPEAKER, WITHIN
from placegraph.outdoor.language.languages import translate, translate_option
from placegraph.world.estimate import WorldEstimate, WorldMode, WorldQuery
from placegraph.world.evidence import WorldEvidence, collect_evidence, list_rooms, match_outdoors
from placegraph.world.status import (
    decide_by_frames,
    decide_by_text,
    decide_without_frames,
    limit_status,
)

if TYPE_CHECKING:
    from placegraph.io.capture.frame import Frame
    from placegraph.world.towns import TownMatch
    from placegraph.world.world import World

PRIOR_MAPPED, PRIOR_IN_TOWN = 0.9, 0.07
"""Probability that somebody who speaks of a room is in a mapped one; in another place of a town."""
MIN_PROBABILITY = 0.005
"""Modes of a smaller probability are left out."""
MAX_POSES = 3
"""Largest number of modes of one scene."""
NEGLIGIBLE = 0.005
"""Scenes that together hold less of the probability are not looked into."""
COMPASS_CONCENTRATION, COMPASS_OUTLIERS = 8.0, 0.1
"""Concentration of a compass (about 20 degrees), and share of outliers."""
NO_SCENES = "There is no scene map in this world, so the frames were not used."


def locate(world: World, query: WorldQuery) -> WorldEstimate:
    """Compute one posterior over place, room and pose; see `World.locate`."""
    if query.budget is not None and not world.planets:
        raise OptionError("`budget` applies only to worlds in shards, but this is none; remove it.")
    text = match_outdoors(world, query)
    if world.candidates is not None:
        world = world.candidates.select(world, query, text)
    if query.capture is not None and not world.scenes and query.text is None:
        raise OptionError(f"capture: {NO_SCENES[0].lower()}{NO_SCENES[1:]}")
    evidence = collect_evidence(world, query, text)
    notes = world.remaining.notes if world.remaining else ()
    if query.capture is not None and world.scenes:
        found = _locate_by_frames(world, query, evidence)
    else:
        found = _locate_by_text(world, query, evidence)
        notes += (NO_SCENES,) if query.capture is not None else ()
    status, reason = limit_status(found, world, query, text.towns)
    notes += tuple(note for town in text.towns.values() for note in town.notes)
    answered = tuple(answer.question.text for answer in query.answers)
    code = found.understood.language if found.understood else "en"
    floor = translate_option("floor {}", code).replace("{}", r"\1")
    reason = re.sub(r"\bfloor ([\w-]+)", floor, translate(reason, code))
    return replace(found, status=status, reason=reason, notes=notes, answered=answered, map=world)


def _locate_by_text(world: World, query: WorldQuery, evidence: WorldEvidence) -> WorldEstimate:
    """Compute the posterior over scenes, rooms and places of towns, without frames."""
    is_indoors = evidence.is_indoors or query.text is None
    if not is_indoors and len(evidence.towns) == 1:  # the town's estimate as it is
        (town,) = evidence.towns.values()
        modes = _make_place_modes(town, 1.0)
        return WorldEstimate(
            town.estimate.status, tuple(modes), town.estimate.reason,
            elsewhere=town.posterior.elsewhere, understood=evidence.parsed, cities=evidence.parts,
        )  # fmt: skip
    has_scenes = is_indoors and (evidence.scenes or evidence.remaining)
    mapped, in_town = (
        (PRIOR_MAPPED, PRIOR_IN_TOWN) if has_scenes else (0.0, PRIOR_MAPPED + PRIOR_IN_TOWN)
    )
    logs = {
        name: float(np.log(mapped * evidence.prior(name))) + w.ratio
        for name, w in evidence.scenes.items()
    } if mapped else {}  # fmt: skip
    towns = {
        n: t.gain + float(np.log(in_town / len(evidence.towns))) for n, t in evidence.towns.items()
    }
    unknown = 1.0 - mapped - (in_town if towns else 0.0)
    weights = np.array([*logs.values(), *towns.values(), np.log(unknown)])
    if mapped and evidence.remaining:  # of no mode, and not elsewhere
        rest = np.log(mapped / evidence.total_near) + evidence.remaining.weight
        weights = np.append(weights, rest)
    shares = np.exp(weights - np.logaddexp.reduce(weights)).tolist()
    modes = []
    for name, share in zip(logs, shares, strict=False):
        modes += _make_room_modes(world, evidence, name, share)
    for name, share in zip(towns, shares[len(logs) :], strict=False):
        modes += _make_place_modes(evidence.towns[name], share)
    elsewhere = shares[len(logs) + len(towns)]
    modes.sort(key=lambda m: -m.probability)
    status, reason = decide_by_text(world, query, evidence, modes, elsewhere)
    return WorldEstimate(
        status, _choose_modes(modes, query), reason, elsewhere=elsewhere,
        understood=evidence.parsed, cities=evidence.parts,
    )  # fmt: skip


def _choose_modes(modes: list[WorldMode], query: WorldQuery) -> tuple[WorldMode, ...]:
    return tuple(m for m in modes if m.probability >= MIN_PROBABILITY)[: query.top] or tuple(
        modes[:1]
    )


def _make_room_modes(
    world: World, evidence: WorldEvidence, name: str, probability: float
) -> list[WorldMode]:
    """Make modes of a scene: its rooms, as far as the text tells them apart; else all of it."""
    rooms = evidence.inside.rooms[name] if evidence.inside else {}
    known = list_rooms(world.library, name)
    if len(known) == 1:
        shares = {known[0]: 1.0}
    elif rooms and max(rooms.values()) * len(known) > 1.5:
        shares = dict(rooms)
    else:
        shares = {"": 1.0}
    w, longitude, latitude, level = evidence.scenes[name], None, None, ""
    covariance = np.full((2, 2), np.nan)
    if w.anchors:
        best = w.anchors[0].anywhere
        longitude, latitude, covariance = best.longitude, best.latitude, best.covariance[:2, :2]
        level = w.anchors[0].anchor.level
    return [
        WorldMode(
            longitude, latitude, share * probability, covariance, building=w.building, scene=name,
            level=level, room=room, explain=partial(evidence.explain, name),
        )
        for room, share in shares.items()
    ]  # fmt: skip


def _make_place_modes(town: TownMatch, share: float) -> list[WorldMode]:
    """Make modes of a town's posterior, which holds a share of the world's.

    A mode names the building that the speaker is in, by the text.
    """
    within = [
        i for i, s in enumerate(town.query.used) if s.relation in WITHIN and s.source == SPEAKER
    ]

    def find_building(place: Place) -> str:
        own = (e for i in within for e in place.evidence[i : i + 1])
        return next((o.name for e in own for o in e.objects if o.id[0] != "n" and o.name), "")

    return [
        WorldMode(
            p.longitude, p.latitude, share * p.probability, p.covariance,
            building=find_building(p) if within else "", place=p,
            explain=partial(lambda place: place.evidence, p),
        )
        for p in town.estimate.modes
    ]  # fmt: skip


def _locate_by_frames(world: World, query: WorldQuery, evidence: WorldEvidence) -> WorldEstimate:
    """Locate the last frame of a capture: place, room and pose."""
    frames = chosen_frames(query.capture or (), query.frames)
    found = defer_colourless(world.library, frames, _propose_scenes(world, frames, evidence))
    left = 1.0 - found.elsewhere - np.cumsum([0.0, *(m.probability for m in found.modes)])
    shown = replace(
        found, modes=found.modes[: min(query.most, max(1, int((left > NEGLIGIBLE).sum())))]
    )
    inside = evidence.parsed.inside if evidence.parsed else None
    answers = localize_in_scenes(
        world.library, frames, shown, description=inside, refine=query.refine, seed=query.seed,
        device=query.device, progress=query.progress,
    )  # fmt: skip
    ratios = {n: w.ratio + float(np.log(w.near)) for n, w in evidence.scenes.items()}
    best = doubt_by_search(choose_scene(answers, ratios), shown, len(answers))
    poses = {mode.scene: a for mode, a in zip(shown.modes, answers, strict=False)}
    if best.status is Status.LOST:
        return _locate_without_frames(world, query, evidence, best, poses)
    lean, _ = search_odds(scene_of(best), shown, len(answers))
    elsewhere = 1.0 / (1.0 + float(np.exp(fit_odds(best) + lean)))
    kept = [a for a in answers if a.status is not Status.LOST]
    logs = np.array([fit_odds(a) + ratios[scene_of(a)] for a in kept])
    shares = (1.0 - elsewhere) * np.exp(logs - np.logaddexp.reduce(logs))
    modes = [
        m
        for answer, share in zip(kept, shares.tolist(), strict=True)
        for m in _make_pose_modes(world, evidence, query, answer, share)
    ]
    is_ok = best.status is Status.OK
    modes.sort(key=lambda m: (is_ok and m.pose is not best.best, -m.probability))
    if modes[0].scene != scene_of(best):  # several poses share the scene where frames fit best
        likelier = next(a for a in kept if scene_of(a) == modes[0].scene)
        best = replace(likelier, status=best.status)
    status, reason, fits = decide_by_frames(best, modes, evidence, query)
    fits &= poses[modes[0].scene].status is Status.OK and world.remaining is None
    return WorldEstimate(
        status, _choose_modes(modes, query), reason, elsewhere=elsewhere, has_only_rivals=fits,
        understood=evidence.parsed, cities=evidence.parts, poses=poses,
    )  # fmt: skip


def _propose_scenes(
    world: World, frames: Sequence[Frame], evidence: WorldEvidence
) -> SceneEstimate:
    """Propose the scenes of frames by all evidence, likeliest first."""
    others, count = world.remaining, len(world.scenes)
    if others is None:
        weighed = infer_from_frames(world.library, frames, None, SearchOptions())
        found = weighed.estimate(world.library, count)
    else:
        count = others.count
        found = SceneEstimate(Status.AMBIGUOUS, others.modes, "", others.elsewhere, others.stats)
    logs = [
        np.log(m.probability + 1e-12)
        + np.log(count * evidence.prior(m.scene))
        + evidence.scenes[m.scene].ratio
        for m in found.modes
    ]
    gains = [t.gain for t in evidence.towns.values()]
    in_town = PRIOR_IN_TOWN / (1.0 - PRIOR_MAPPED)
    off = np.log(in_town * (np.mean(np.exp(gains)) if gains else 1.0) + 1.0 - in_town)
    weights = np.array([np.log(found.elsewhere + 1e-12) + off, *logs])
    rest = np.log(count / evidence.total_near) + others.weight if others else -np.inf
    shares = np.exp(weights - np.logaddexp(np.logaddexp.reduce(weights), rest))
    modes = [replace(m, probability=float(p)) for m, p in zip(found.modes, shares[1:], strict=True)]
    modes.sort(key=lambda m: -m.probability)
    return replace(found, modes=tuple(modes), elsewhere=float(shares[0]))


def _make_pose_modes(
    world: World, evidence: WorldEvidence, query: WorldQuery, answer: PoseEstimate, share: float
) -> list[WorldMode]:
    """Make modes of the best poses in a scene, on Earth by the likeliest candidate of its anchor."""
    name = scene_of(answer)
    scene, w = world.scenes[name], evidence.scenes[name]
    out = []
    for mode in answer.modes[:MAX_POSES]:
        # a library's poses are in the axes of the part of a merged map, anchors in the map's
        part = mode.scene.partition("/")[2] or scene.scenes[0]
        there = np.linalg.inv(scene.scene_from_map[scene.scenes.index(part)]) @ mode.map_from_camera
        at = there[:3, 3]
        made = WorldMode(
            None, None, share * mode.probability, np.full((2, 2), np.nan), scene=name,
            room=find_room_name(scene, at), pose=mode, explain=partial(_explain, evidence, name, mode),
        )  # fmt: skip
        own = [k for k, s in enumerate(w.anchors) if s.part == part]
        if own:
            anchors = [w.anchors[k].anchor for k in own]
            shares = w.shares[own] * [_weigh_heading(a.pose(there).heading, query) for a in anchors]
            best = int(shares.argmax())
            earth = anchors[best].pose(
                there, mode.covariance, room=made.room, storey=find_storey(scene, at)[0]
            )
            chance = float(shares[best] / shares.sum())
            earth = replace(earth, probability=share * mode.probability * chance)
            made = replace(
                made, longitude=earth.longitude, latitude=earth.latitude, earth=earth,
                covariance=earth.covariance[:2, :2], building=earth.building, level=earth.level,
            )  # fmt: skip
        out.append(made)
    return out


def _weigh_heading(heading: float, query: WorldQuery) -> float:
    """Likelihood of a camera's heading, given the compass."""
    if query.heading is None:
        return 1.0
    off = float(angle_between(heading, query.heading))
    return COMPASS_OUTLIERS + (1.0 - COMPASS_OUTLIERS) * float(
        np.exp(COMPASS_CONCENTRATION * (np.cos(off) - 1.0))
    )


def _explain(evidence: WorldEvidence, name: str, mode: PoseMode) -> tuple[Evidence, ...]:
    """Combine the evidence of a pose with that of its scene, each statement once."""
    own = {e.statement for e in mode.evidence}
    return (*(e for e in evidence.explain(name) if e.statement not in own), *mode.evidence)


def _locate_without_frames(
    world: World, query: WorldQuery, evidence: WorldEvidence, best: PoseEstimate,
    poses: dict[str, PoseEstimate],
) -> WorldEstimate:  # fmt: skip
    """Make the estimate where frames fit none of the searched scenes."""
    by_text, modes = None, []
    if query.text is not None or query.near is not None:
        by_text = _locate_by_text(world, query, evidence)
        modes = [m for m in by_text.modes if m.scene not in poses]
    elif best.modes:
        modes = _make_pose_modes(world, evidence, query, best, 0.0)
    status, reason = decide_without_frames(best, by_text, modes)
    made = by_text or WorldEstimate(status, (), reason, elsewhere=1.0)
    return replace(made, status=status, modes=tuple(modes), reason=reason, poses=poses)
