"""The answer where there are frames: a pose in one of the scenes, which words and a fix tell apart.

Scenes are proposed by what frames show and by all else that is known; then poses are sought in the
likeliest, one by one, and the odds of each add to what is known of its scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import SceneEstimate, Status
from placegraph.core.geometry import angle_between
from placegraph.indoor.library.answer import by_frames as by_frames_in
from placegraph.indoor.library.localize import looked_into
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.map.floor import storey_at
from placegraph.indoor.map.rooms import room_at
from placegraph.indoor.pose.query import chosen_frames
from placegraph.indoor.status import choose_scene, doubt_by_search, fit_odds, scene_of, search_odds
from placegraph.world.estimate import WorldEstimate, WorldMode
from placegraph.world.floors import ratio_of
from placegraph.world.standing import nowhere
from placegraph.world.words import IN_TOWN, LEAST, MAPPED, by_words

if TYPE_CHECKING:
    from placegraph.core.estimate import Evidence, PoseEstimate, PoseMode
    from placegraph.io.capture.frame import Frame
    from placegraph.world.known import Known
    from placegraph.world.witnesses import Witness, Witnesses
    from placegraph.world.world import World


POSES = 3
"""Poses of each scene that are told."""
LEFT = 0.005
"""Scenes that hold less of the probability together are not looked into."""
FAR_OFF = 0.01
"""A fix that fits a scene no better than this contradicts it."""
OTHER_FLOOR = -1.0
"""What was said of floors contradicts a level below this [nat]."""
SHARPNESS, WILD = 8.0, 0.1
"""Of a compass: concentration (about 20 degrees), and the share of headings that are far off."""
TURNED = float(np.radians(60.0))
"""A heading so far off contradicts a pose [rad]."""


def by_frames(world: World, known: Known, witnesses: Witnesses) -> WorldEstimate:
    """Place, room and pose of a capture's last frame."""
    frames = chosen_frames(known.capture or (), known.frames)
    found = proposed(world, frames, witnesses)
    left = 1.0 - found.elsewhere - np.cumsum([0.0, *(m.probability for m in found.modes)])
    shown = replace(found, modes=found.modes[: min(known.most, max(1, int((left > LEFT).sum())))])
    inside = witnesses.understood.inside if witnesses.understood else None
    answers = looked_into(
        world.library, frames, shown, description=inside, refine=known.refine, seed=known.seed,
        device=known.device, progress=known.progress,
    )  # fmt: skip
    said = {n: w.said + float(np.log(w.near)) for n, w in witnesses.scenes.items()}
    best = doubt_by_search(choose_scene(answers, said), shown, len(answers))
    poses = {mode.scene: a for mode, a in zip(shown.modes, answers, strict=False)}
    if best.status is Status.LOST:
        return _lost(world, known, witnesses, best, poses)
    shares, elsewhere = _shares(answers, best, said, shown)
    modes = [
        m
        for answer in answers
        if answer.status is not Status.LOST
        for m in _modes(world, witnesses, known, answer, shares[scene_of(answer)])
    ]
    modes.sort(key=lambda m: (m.pose is not best.best, -m.probability))
    status, reason = _judged(best, modes[0], witnesses, known)
    return WorldEstimate(
        status, tuple(m for m in modes if m.probability >= LEAST)[: known.top] or tuple(modes[:1]),
        reason, elsewhere=elsewhere, understood=witnesses.understood,
        cities=witnesses.parts, poses=poses,
    )  # fmt: skip


def proposed(world: World, frames: Sequence[Frame], witnesses: Witnesses) -> SceneEstimate:
    """Scenes that frames may show, with all else that is known, likeliest first."""
    others, count = world.others, len(world.scenes)
    if others is None:
        found = by_frames_in(world.library, frames, None, SearchOptions()).estimate(
            world.library, count
        )
    else:
        count = others.count
        found = SceneEstimate(Status.AMBIGUOUS, others.modes, "", others.elsewhere, others.stats)
    logs = [
        np.log(m.probability + 1e-12)
        + np.log(count * witnesses.prior(m.scene))
        + witnesses.scenes[m.scene].said
        for m in found.modes
    ]
    gains = [t.gain for t in witnesses.towns.values()]
    in_town = IN_TOWN / (1.0 - MAPPED)
    off = np.log(in_town * (np.mean(np.exp(gains)) if gains else 1.0) + 1.0 - in_town)
    weights = np.array([np.log(found.elsewhere + 1e-12) + off, *logs])
    rest = np.log(count / witnesses.crowded) + others.weight if others else -np.inf
    shares = np.exp(weights - np.logaddexp(np.logaddexp.reduce(weights), rest))
    modes = [replace(m, probability=float(p)) for m, p in zip(found.modes, shares[1:], strict=True)]
    modes.sort(key=lambda m: -m.probability)
    return replace(found, modes=tuple(modes), elsewhere=float(shares[0]))


def _shares(
    answers: list[PoseEstimate], best: PoseEstimate, said: dict[str, float], found: SceneEstimate
) -> tuple[dict[str, float], float]:
    """Probability of each scene that was looked into, and of being in none of them."""
    lean, _ = search_odds(scene_of(best), found, len(answers))
    off = 1.0 / (1.0 + float(np.exp(fit_odds(best) + lean)))
    kept = [a for a in answers if a.status is not Status.LOST]
    logs = np.array([fit_odds(a) + said[scene_of(a)] for a in kept])
    shares = (1.0 - off) * np.exp(logs - np.logaddexp.reduce(logs))
    return {scene_of(a): float(p) for a, p in zip(kept, shares, strict=True)}, off


def _modes(
    world: World, witnesses: Witnesses, known: Known, answer: PoseEstimate, share: float
) -> list[WorldMode]:
    """The best poses in a scene, on Earth by the likeliest candidate of its anchor."""
    name = scene_of(answer)
    scene, w = world.scenes[name], witnesses.scenes[name]
    out = []
    for mode in answer.modes[:POSES]:
        # a library tells poses in the axes of the part of a merged map, anchors are in the map's
        part = mode.scene.partition("/")[2] or scene.scenes[0]
        there = np.linalg.inv(scene.scene_from_map[scene.scenes.index(part)]) @ mode.map_from_camera
        at = there[:3, 3]
        room = room_at(scene, at)
        explain = partial(_evidence, witnesses, name, mode)
        own = [k for k, s in enumerate(w.standings) if s.part == part]
        if not own:
            out.append(WorldMode(
                None, None, share * mode.probability, nowhere(), scene=name, room=room, pose=mode,
                explain=explain,
            ))  # fmt: skip
            continue
        anchors = [w.standings[k].anchor for k in own]
        looks = [_looks(a.pose(there).heading, known) for a in anchors]
        shares = w.shares[own] * looks
        best = int(shares.argmax())
        chance = float(shares[best] / shares.sum())
        earth = anchors[best].pose(
            there, mode.covariance, room=room, storey=storey_at(scene, at)[0]
        )
        earth = replace(earth, probability=share * mode.probability * chance)
        out.append(WorldMode(
            earth.longitude, earth.latitude, share * mode.probability, earth.covariance[:2, :2],
            building=earth.building, scene=name, level=earth.level, room=room, earth=earth,
            pose=mode, explain=explain,
        ))  # fmt: skip
    return out


def _looks(heading: float, known: Known) -> float:
    """How well a camera's heading fits the compass."""
    if known.heading is None:
        return 1.0
    off = float(angle_between(heading, known.heading))
    return WILD + (1.0 - WILD) * float(np.exp(SHARPNESS * (np.cos(off) - 1.0)))


def _evidence(witnesses: Witnesses, name: str, mode: PoseMode) -> tuple[Evidence, ...]:
    """What speaks for a pose; a statement that the pose was judged by speaks of that, not of the scene."""
    told = {e.statement for e in mode.evidence}
    return (*(e for e in witnesses.evidence(name) if e.statement not in told), *mode.evidence)


def _judged(
    best: PoseEstimate, mode: WorldMode, witnesses: Witnesses, known: Known
) -> tuple[Status, str]:
    """Status and reason: of the poses, unless something else that is known contradicts them."""
    w = witnesses.scenes[mode.scene]
    where = f"In {mode.where}: {best.reason}"
    against = contradictions(w, mode, known)
    if not against or "not what was said" in best.reason:
        return best.status, where
    also = "But" if best.status is Status.OK else "And"
    return Status.AMBIGUOUS, f"{where} {also} {' and '.join(against)}."


def contradictions(w: Witness, mode: WorldMode, known: Known) -> list[str]:
    """What of all that is known does not fit a pose, in words."""
    out = []
    if w.outside < 0:
        out.append("what was said of the outside is not so there")
    if w.inside < 0 and not any(e.verdict == "for" for e in mode.evidence if not e.objects):
        out.append("what was said of the room is not so there")
    if mode.level and ratio_of(w.floors, mode.level) < OTHER_FLOOR:
        out.append(f"level {mode.level} is not the floor that was said")
    if known.near is not None and w.standings and w.near < FAR_OFF:
        out.append("it is far from the fix")
    if known.heading is not None and mode.earth is not None:
        off = float(angle_between(mode.earth.heading, known.heading))
        if off > TURNED:
            out.append(f"the camera looks {np.degrees(off):.0f} degrees away from the heading")
    return out


def _lost(
    world: World, known: Known, witnesses: Witnesses, best: PoseEstimate,
    poses: dict[str, PoseEstimate],
) -> WorldEstimate:  # fmt: skip
    """Frames fit in no scene that was looked into: what words say stands, and is not certain."""
    if known.text is None and known.near is None:
        modes = list(_modes(world, witnesses, known, best, 0.0)) if best.modes else []
        return WorldEstimate(Status.LOST, tuple(modes), best.reason, elsewhere=1.0, poses=poses)
    told = by_words(world, known, witnesses)
    rest = tuple(m for m in told.modes if m.scene not in poses)
    reason = f"The frames fit in none of the scenes that were looked into: {best.reason}"
    status = Status.AMBIGUOUS if rest and told.status is not Status.LOST else Status.LOST
    return replace(told, status=status, modes=rest, reason=reason, poses=poses)
