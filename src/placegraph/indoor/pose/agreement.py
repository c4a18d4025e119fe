"""Agreement of a pose with frames, and faults of the input that explain why they do not agree.

Each fault has a row in docs/benchmarks/indoor.md (*Robustness*, *Bad input*), which the function that
looks for it names.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.core.geometry import (
    Floats,
    compose,
    level_from_camera,
    wrap_angle,
)
from placegraph.indoor.likelihood.observe import (
    FINE,
    Observation,
    View,
    describe_unit_error,
    suspect_unit_factor,
)
from placegraph.indoor.likelihood.score import Scorer, reading_ratio
from placegraph.indoor.likelihood.score_kernels import (
    COLOUR,
    DEPTH,
    FLAT,
    SEMANTIC,
    TONE,
    sum_surface_steps,
)
from placegraph.indoor.map.scene import Scene, make_object_ref
from placegraph.indoor.pose.window import Window

SPEAK = 0.02
"""Log-likelihood of colours from which on depth is not the only evidence [nat a sample] ..."""
CLEAR = 0.035
"""... from which on colours are believed alone ..."""
_MOST_COLOUR = 0.12
"""... and which counts at most."""
_MOST_TONE = 0.2
"""Largest log-likelihood of tones that counts: a wall and a floor look alike in any room."""
TELLING = 1.0
"""Log-likelihood ratio below which an object is no evidence [nat]."""
WITNESSES = 4
"""Number of objects whose labels support a pose as firmly as a surface does."""
_SLIM = 0.01
"""Term added to `Agreement.constraint` before its logarithm is taken."""


@dataclass(frozen=True, slots=True)
class ConfidenceModel:
    """Coefficients of the log odds that frames fit, of a pose without a rival.

    A logistic regression over even windows of house and office, localized in their own maps and in those
    of other places: `placegraph-lab table indoor_robustness --fit`. The coefficients of tones were fitted
    later, to windows with depth and colours and their wrong rivals.
    """

    level: float
    depth: tuple[float, float, float]
    """Coefficients of the presence of depth, of the log odds of its agreeing share, and of the log of the
    constraint by surfaces if depth is the only evidence."""
    colour: tuple[float, float]
    """Coefficients of the presence of colours, and of the log-likelihood of their steps [1 / nat]."""
    tone: tuple[float, float]
    """Coefficients of the presence of colours beside depth, and of the log-likelihood of tones [1 / nat]."""

    @property
    def coefficients(self) -> tuple[float, ...]:
        """(8,) coefficients of `features`."""
        return (self.level, *self.depth, *self.colour, *self.tone)

    def tone_odds(self, tone: float) -> float:
        """Return the log odds that tones add by their log-likelihood [nat]."""
        return self.tone[0] + self.tone[1] * min(max(tone, 0.0), _MOST_TONE)

    def odds(self, agreed: Agreement) -> float:
        """Return the log odds; minus infinity without depth and colour."""
        if np.isnan(agreed.depth) and np.isnan(agreed.colour):
            return -np.inf
        return float(np.dot(self.coefficients, features(agreed)))

    def probability(self, agreed: Agreement, probability: float) -> float:
        """Return the probability that the best pose, which has `probability` among its rivals, is right."""
        return probability / (1.0 + float(np.exp(-self.odds(agreed))))


def features(agreed: Agreement) -> list[float]:
    """Return the features (8,) that the coefficients of `ConfidenceModel` multiply."""
    depth = [0.0, 0.0, 0.0]
    if not np.isnan(agreed.depth):
        bare = _share_of_depth_alone(agreed) * float(np.log(agreed.constraint + _SLIM))
        depth = [1.0, log_odds(agreed.depth, 0.01), bare]
    colour = [0.0, 0.0]
    if not np.isnan(agreed.colour):
        colour = [1.0, float(np.clip(agreed.colour, 0.0, _MOST_COLOUR))]
    tone = [0.0, 0.0]
    if not np.isnan(agreed.tone):
        tone = [1.0, float(np.clip(agreed.tone, 0.0, _MOST_TONE))]
    return [1.0, *depth, *colour, *tone]


def _share_of_depth_alone(agreed: Agreement) -> float:
    """Return the weight (0 to 1) of depth as the only evidence: clear colours or several objects lower it."""
    colour = 0.0 if np.isnan(agreed.colour) else (agreed.colour - SPEAK) / (CLEAR - SPEAK)
    named = 0.0 if np.isnan(agreed.semantic) else np.clip(agreed.weights / TELLING, 0.0, 1.0).sum()
    lifted = np.clip([colour, named / WITNESSES], 0.0, 1.0)
    return float(np.prod(1.0 - lifted))


def log_odds(share: float, least: float) -> float:
    """Return the log odds of a share, clipped to `least` from 0 and 1."""
    share = min(max(share, least), 1.0 - least)
    return float(np.log(share / (1.0 - share)))


CONFIDENCE = ConfidenceModel(
    level=6.44, depth=(-3.0, 1.77, 2.26), colour=(-5.54, 31.36), tone=(2.12, 21.28)
)


_NAMED = 12  # objects named


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """Agreement of a pose with frames, by sense and by object."""

    covered: float
    """Share of the samples at which the map has something."""
    semantic: float
    """Share that fits of the informative patches that see the map; NaN: no patches."""
    depth: float
    """Share of depth readings on the map's surface within one deviation; NaN without such readings."""
    colour: float
    """Mean log-likelihood of the steps of colour per independent pair [nat]; NaN: no colours."""
    weights: Floats
    """(N,) log-likelihood ratio of the patches and readings that concern each object [nat]."""
    counts: Floats
    """(N,) number of patches or readings that concern each object."""
    ratio: float = 0.0
    """Log-likelihood ratio of a frame against anywhere in the map [nat]."""
    constraint: float = 0.0
    """Constraint of the position by surfaces, 0 to 1/3: least eigenvalue of the scatter of the normals
    of readings that lie on surfaces, as a share. A blank wall and the floor: 0."""
    tone: float = np.nan
    """Mean log-likelihood of the colours themselves, beside depth, per independent sample [nat]; NaN:
    no colours, or no depth."""
    texture: float = np.nan
    """Correlation of the view's steps of colour with the map's, within surfaces; NaN: no colours."""
    frames: Floats = field(default_factory=lambda: np.full((0, 3), np.nan))
    """(T, 3) agreement of each frame by itself: semantic, depth, colour."""

    def numbers(self) -> dict[str, float | None]:
        """Return the numbers that decide the status, ready for `json.dumps`; None: no such sense."""
        names = ("covered", "semantic", "depth", "colour", "tone", "texture", "ratio")
        values = {name: float(getattr(self, name)) for name in names}
        values["held"] = self.constraint
        values["witnesses"] = float((self.weights > TELLING).sum())
        values["odds"] = CONFIDENCE.odds(self)
        return {name: value if np.isfinite(value) else None for name, value in values.items()}


def agreement(scorer: Scorer, pose: Floats, views: Sequence[View], steps: Floats) -> Agreement:
    """Measure the agreement of a pose (4,) of the reference frame with all frames of the window."""
    scene, noise = scorer.scene, scorer.model.noise
    count = len(scene)
    weights, counts = np.zeros(count), np.zeros(count)
    samples = hits = 0
    fits = np.zeros((len(views), 4, 2))
    total, faced, textures = 0.0, np.zeros((3, 3)), np.zeros(4)
    for fit, view, step in zip(fits, views, steps, strict=True):
        at = compose(pose, step)
        scores, triangles, distances, shown = scorer.show(at, view)
        used = view.patch >= 0
        hit = used & (triangles >= 0)
        samples, hits = samples + int(used.sum()), hits + int(hit.sum())
        objects = np.where(triangles >= 0, scene.mesh.object_of[triangles], count)
        if view.terms[SEMANTIC]:
            size = len(view.weight)
            ratio = view.semantic[view.patch, objects]
            mean = np.bincount(view.patch[used], ratio[used], size)
            shares = np.bincount(view.patch[used], minlength=size)
            is_informative = (view.weight > 0) & (np.bincount(view.patch[hit], minlength=size) > 0)
            logs = np.log(np.maximum(mean[is_informative] / shares[is_informative], 1e-6))
            fit[SEMANTIC] = (logs > 0).sum(), is_informative.sum()
            about = _concerned(
                view.semantic[:, :count], view.patch[hit], objects[hit], is_informative, logs
            )
            weights += np.bincount(about, logs * view.weight[is_informative], count)
            counts += np.bincount(about, minlength=count)
        if view.terms[DEPTH]:
            read = hit & (view.depth > 0)
            error = distances[read] - view.depth[read]
            sd = noise.depth_floor + noise.depth_slope * view.depth[read]
            ratio = reading_ratio(error, sd, noise) - view.background_depth[read]
            lies = np.abs(error) < sd
            fit[DEPTH] = lies.sum(), read.sum()
            normals = scene.normals[triangles[read][lies]]
            faced += normals.T @ normals
            share = noise.depth_weight / max(1, int(used.sum()))
            weights += np.bincount(objects[read], ratio * share, count)
            counts += share * np.bincount(objects[read], minlength=count)
        total += float(scores.sum())
        if view.terms[COLOUR]:
            share = float(hit.sum()) / used.sum()
            fit[COLOUR] = scores[COLOUR], max(1e-9, noise.colour_weight * share)
            textures += sum_surface_steps(at, view, scene.normals, triangles, distances, shown)
            if view.terms[DEPTH]:
                fit[TONE] = scores[TONE], max(1e-9, noise.tone_weight * share)
    with np.errstate(invalid="ignore"):
        semantic, depth, colour, tone = np.divide(*fits.sum(axis=0).T).tolist()
        return Agreement(
            covered=hits / max(1, samples),
            semantic=semantic,
            depth=depth,
            colour=colour,
            tone=tone,
            texture=_correlate(textures),
            weights=weights,
            counts=counts,
            ratio=total / max(1, len(views)),
            constraint=float(np.linalg.eigvalsh(faced)[0] / max(1.0, np.trace(faced))),
            frames=fits[:, :TONE, 0] / fits[:, :TONE, 1],
        )


def _correlate(sums: Floats) -> float:
    """Return the correlation of steps by their sums (4,), not below 0; NaN without any."""
    qq, rr, qr, count = sums
    if not count:
        return np.nan
    return max(0.0, float(qr / np.sqrt((qq + count * FLAT) * (rr + count * FLAT))))


REACH = 4
"""Number of values of `reach`."""


def reach(agreed: Agreement, correlation: float = np.nan) -> Floats:
    """Return log odds of depth, correlation of textures, tones [nat], and correlation of images.

    `correlation`: of held-out parts of images with the map at a refined pose; NaN: not compared.
    """
    depth = np.nan if np.isnan(agreed.depth) else log_odds(agreed.depth, 0.01)
    return np.array([depth, agreed.texture, agreed.tone, correlation])


_REPEATING = 0.25
"""Share of its texture that a map's own frames find elsewhere, from which on the map repeats itself."""
_UNEVEN = 0.2, 0.1
"""Deviation of a map's own agreement, as a share of its mean, of maps that do not repeat themselves and
of those that do: light and viewpoints change."""
_SEARCHED = 1.0
"""Log odds of a pose against all places that were not searched; 0 in a map that repeats itself."""
_COLOURS = np.array([[1.5, 0.5, 0.0], [1.5, 0.5, 1.0]])
"""Weights of textures, tones and correlation of images, of both kinds of maps: of any two images of a
room tones agree."""
_REPEATS = 0.1, 0.5
"""Probability that a place of a map looks like one elsewhere, of both kinds of maps."""


def searched_odds(agreed: Agreement, own: Floats | None, correlation: float = np.nan) -> float:
    """Return the log odds that a pose is right, and not of a place that was not searched or not mapped.

    At a right pose, frames agree as well as those that the map was made of, with normal errors. At a wrong
    pose they agree by any amount less. Each sense of colour adds the logarithm of the ratio of both
    densities, by its weight. Depth counts by the share of the map that repeats itself: elsewhere a moved
    chair lowers it, too. A map that repeats itself asks for more, as places beside it may look like its
    own. `own`: (2 K + 1,), a row of `Scene.own_agreement`; if it is unknown, the odds are infinite.
    """
    if own is None or np.isnan(own[-1]):
        return np.inf
    repeating = int(own[-1] >= _REPEATING)
    means, repeats = own[:REACH], _REPEATS[repeating]
    deviations = np.hypot(own[REACH:-1], _UNEVEN[repeating] * means) + 1e-6
    short = np.maximum((means - reach(agreed, correlation)) / deviations, 0.0)
    known = np.isfinite(short)
    if not known.any():
        return np.inf
    gains = np.log(np.maximum(means / (deviations * np.sqrt(2.0 * np.pi)), 1.0)) - 0.5 * short**2
    odds = float(_COLOURS[repeating][known[1:]] @ gains[1:][known[1:]]) - log_odds(repeats, 0.0)
    odds += 0.0 if repeating else _SEARCHED
    return odds - 0.5 * repeats * float(short[0] ** 2) if known[0] else odds


def both_odds(one: float, other: float) -> float:
    """Return the log odds that two independent statements of log odds `one` and `other` are true."""
    if np.isinf(other):
        return one
    return -float(np.logaddexp(np.logaddexp(-one, -other), -one - other))


def _concerned(
    semantic: NDArray[np.float32],
    patch: NDArray[np.int32],
    objects: NDArray[np.int32],
    is_informative: NDArray[np.bool_],
    logs: Floats,
) -> NDArray[np.int64]:
    """Return the object that each informative patch is evidence for or against; `objects` of hits.

    A patch that fits supports the object that it sees. A patch that does not fit contradicts the object
    that it names; if it names several (all chairs of a map), the object that the map shows there.
    """
    size, count = semantic.shape
    pairs = patch * np.int64(count) + objects
    sums = np.bincount(pairs, semantic[patch, objects], size * count).reshape(size, count)
    seen = np.bincount(pairs, minlength=size * count).reshape(size, count)
    named = semantic.argmax(axis=1)
    several = (semantic == semantic.max(axis=1, keepdims=True)).sum(axis=1) > 1
    blamed = np.where(several, seen.argmax(axis=1), named)
    return np.asarray(
        np.where(logs > 0, sums.argmax(axis=1)[is_informative], blamed[is_informative])
    )


def explain(scene: Scene, agreed: Agreement) -> tuple[Evidence, ...]:
    """Describe the evidence for and against a pose, heaviest first."""
    order = np.argsort(-np.abs(agreed.weights), kind="stable")
    rows = order[agreed.counts[order] > 0][:_NAMED].tolist()
    out = [_of_object(scene, n, float(agreed.weights[n])) for n in rows]
    if not np.isnan(agreed.depth):
        out.append(
            Evidence(
                "depth",
                "for" if agreed.depth > 0.5 else "against",
                float(agreed.depth),
                note=f"{agreed.depth:.0%} of the readings lie on the map's surfaces",
            )
        )
    if not np.isnan(agreed.colour):
        out.append(
            Evidence(
                "colour",
                "for" if agreed.colour > SPEAK else "silent",
                float(agreed.colour),
                note="edges agree with the map"
                if agreed.colour > SPEAK
                else "edges hardly agree with the map",
            )
        )
    if agreed.covered < 0.75:
        out.append(
            Evidence(
                "coverage", "silent", 0.0,
                note=f"{1.0 - agreed.covered:.0%} of the view lies outside the map",
            )
        )  # fmt: skip
    return tuple(out)


def _of_object(scene: Scene, n: int, weight: float) -> Evidence:
    graph = scene.graph
    verdict = "for" if weight > TELLING else "against" if weight < -TELLING else "silent"
    return Evidence(
        statement=f"{graph.labels[n]} {graph.ids[n]}",
        verdict=verdict,
        weight=weight,
        objects=(make_object_ref(scene, n),),
        note="" if verdict != "against" else "not at its place in the map",
    )


_FLAT = 2.0
"""Deviation of the means of an image's blocks, of 255 steps, below which the image is blank."""
_STILL = 1e-6
"""Largest change of matrices of odometry that is no estimate: estimates of a camera that stands drift."""
_BLOCKS = (8, 12)
_MOVED, _TURNED = 0.1, 0.1
"""Way [m] and turn [rad] over which no two images are equal."""
_FITS, _MISSES = 0.75, 0.5
"""Share of depth readings on the map's surfaces in frames that fit, and in frames that do not."""
_MUTE = SPEAK / 4.0
"""Largest log-likelihood of colours in a frame taken elsewhere [nat a sample]."""


def find_image_fault(window: Window) -> str:
    """Return the fault of images that fit no map, as a sentence; empty: none.

    Rows *lens cap* and *frozen image*.
    """
    others = any(s.depth is not None or s.patches is not None for s in window.observations)
    if not others and all(s.rgb is not None and _is_blank(s.rgb) for s in window.observations):
        return (
            "The lens seems to be covered: no image shows anything, and there is no depth. "
            "Uncover it, or check the camera's output."
        )
    frozen = _find_frozen_run(window)
    if frozen is None:
        return ""
    first, last = (window.observations[i].frame.index for i in frozen)
    return (
        f"The images are frozen: frames {first} to {last} are identical, but the odometry "
        "shows motion. Restart the camera, or remove repeated frames."
    )


def _is_blank(rgb: NDArray[Any]) -> bool:
    """Return whether an image (H, W, 3) has no contrast but the noise of its pixels."""
    rows, columns = (n // k * k for n, k in zip(rgb.shape, _BLOCKS, strict=False))
    some = rgb[:rows:2, :columns:2].astype(np.float32).mean(axis=2)
    height, width = (n // k for n, k in zip(some.shape, _BLOCKS, strict=True))
    some = some[: height * _BLOCKS[0], : width * _BLOCKS[1]]
    means = some.reshape(_BLOCKS[0], height, _BLOCKS[1], width).mean(axis=(1, 3))
    return bool(means.std() < _FLAT)


def _find_frozen_run(window: Window) -> tuple[int, int] | None:
    """Return the first and last row of the longest run of equal frames over which the camera moved.

    Two equal frames among many are a frame that was sent twice, except at the end, where the answer is.
    """
    found, start, last = None, 0, len(window) - 1
    for i in range(1, len(window) + 1):
        if i <= last and _have_equal_image(window.observations[i - 1], window.observations[i]):
            continue
        ends_now, count, poses = i - 1 == last, i - start, window.poses[start:i]
        way = np.linalg.norm(poses[-1, :3] - poses[0, :3])
        turn = np.abs(wrap_angle(poses[:, 3] - poses[0, 3])).max()
        if count > 1 and (count > 2 or ends_now) and (way > _MOVED or turn > _TURNED):
            found = max(found or (start, start), (start, i - 1), key=lambda run: run[1] - run[0])
        start = i
    return found


def _have_equal_image(one: Observation, other: Observation) -> bool:
    """Return whether two frames have an equal image: the noise of sensors lets no image repeat.

    Blank images prove nothing: a covered lens may be free of noise.
    """
    pairs = ((one.rgb, other.rgb), (one.depth, other.depth))
    return any(
        a is not None
        and b is not None
        and a.shape == b.shape
        and all(  # few pixels tell most images apart
            np.array_equal(a[::y, ::x], b[::y, ::x], equal_nan=a.dtype.kind == "f")
            for y, x in ((49, 35), (7, 5))
        )
        and not (a.dtype == np.uint8 and _is_blank(a))
        for a, b in pairs
    )


def find_contradiction(window: Window, frames: Floats) -> str:
    """Return a sentence about frames that contradict each other by their odometry; empty where none do.

    A frame that fits and one that does not cannot both have been taken where odometry says. Rows *half
    elsewhere* and *no odometry*; of images without depth, the rows *colour alone* of absent scenes.

    Parameters
    ----------
    frames
        (T, 3) agreement of each frame with one trajectory (`Agreement.frames`).

    """
    if _is_odometry_missing(window.observations):
        return (
            "The odometry shows no motion, but the depth images do; check the odometry, or "
            "localize each frame separately."
        )
    depth, colour = frames[:, 1], frames[:, 2]
    by_images = np.isnan(depth) & np.isnan(frames[:, 0])
    for i in np.flatnonzero(by_images):
        rgb = window.observations[i].rgb
        by_images[i] = rgb is not None and not _is_blank(rgb)
    misses = np.where(by_images, colour < _MUTE, (depth < _MISSES) & ~(colour > SPEAK))
    fits = np.where(by_images, colour > SPEAK, depth > _FITS)
    few = misses.sum() < max(2, round(0.3 * len(depth)))
    if fits.sum() < 2 or (few and not (by_images & misses)[-1]):
        return ""
    rows = [window.observations[i].frame.index for i in np.flatnonzero(misses)]
    listed = ", ".join(map(str, rows[:6])) + (", ..." if len(rows) > 6 else "")
    return (
        f"Frames {listed} contradict the others: they were taken elsewhere, or the odometry "
        "jumped. Localize each part separately."
    )


def _is_odometry_missing(observations: list[Observation]) -> bool:
    """Return whether odometry is one pose, although half of the depth readings changed."""
    first, last = observations[0].depth, observations[-1].depth
    if len(observations) < 2 or first is None or last is None or first.shape != last.shape:
        return False
    change = np.abs(first[::7, ::5] - last[::7, ::5])
    read = np.isfinite(change)
    still = np.ptp([s.frame.odometry for s in observations], axis=0).max() < _STILL
    return bool(still and read.any() and np.median(change[read]) > _MOVED)


def undo_faults(window: Window) -> Iterator[tuple[Window, str]]:
    """Yield windows with depth with one fault undone, and a sentence about the fault.

    Rows *gravity up* and *mirrored*, and depth in another unit.
    """
    query, observations = replace(window.query, prior=None), window.observations
    if all(s.depth is None for s in observations):
        return
    factor = suspect_unit_factor(window.judging.views(FINE), window.table.background)
    if factor is not None:
        scaled = [
            replace(s, depth=None if s.depth is None else s.depth / np.float32(factor))
            for s in observations
        ]
        yield (
            Window(query, window.scorer, scaled),
            describe_unit_error(observations[-1].frame, factor),
        )
    if np.mean([s.frame.gravity[1] for s in observations]) < 0:  # or the camera is held upside down
        upright = [
            replace(
                s,
                frame=replace(s.frame, gravity=-s.frame.gravity),
                level=level_from_camera(-s.frame.gravity),
            )
            for s in observations
        ]
        yield (
            Window(query, window.scorer, upright),
            (
                "Gravity seems to point up, because the frames fit when it is reversed. "
                "Give the direction in which objects fall; an accelerometer at rest "
                "measures the opposite."
            ),
        )
    yield (
        Window(query, window.scorer, [_mirror(s) for s in observations]),
        (
            "The images seem to be mirrored, because they fit when flipped. Give images as "
            "the camera sees them."
        ),
    )


def _mirror(observation: Observation) -> Observation:
    patches, depth, rgb = observation.patches, observation.depth, observation.rgb
    if patches is not None:
        patches = replace(patches, rows=patches.rows.reshape(patches.grid)[:, ::-1].ravel())
    return replace(
        observation,
        patches=patches,
        depth=None if depth is None else np.ascontiguousarray(depth[:, ::-1]),
        rgb=None if rgb is None else np.ascontiguousarray(rgb[:, ::-1]),
    )
