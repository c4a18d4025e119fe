"""Agreement of a pose with what frames show, and the confidence that follows from it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.core.geometry import Floats, compose
from placegraph.indoor.likelihood.observe import View
from placegraph.indoor.likelihood.score import Scorer, reading_ratio
from placegraph.indoor.likelihood.score_kernels import COLOUR, DEPTH, SEMANTIC, TONE, look
from placegraph.indoor.map.scene import Scene, make_object_ref

SPEAK = 0.02
"""What colours tell from which on they speak, so that depth is not alone [nat a sample] ..."""
CLEAR = 0.035
"""... from which on they speak clearly enough to be believed alone ..."""
_MOST_COLOUR = 0.12
"""... and what counts at most."""
_MOST_TONE = 0.2
"""The same of tones: a wall and a floor have those of any room."""
TELLING = 1.0
"""Log-likelihood ratio below which an object says nothing [nat]."""
WITNESSES = 4
"""Objects whose labels speak for a pose as firmly as a surface."""
_SLIM = 0.01
"""Added to how firmly surfaces hold a pose, before its logarithm is taken."""


@dataclass(frozen=True, slots=True)
class ConfidenceModel:
    """Coefficients of the log odds that frames fit, of a pose without a rival.

    By logistic regression over even windows of house and office, asked in their own maps and in those of
    other places, as `placegraph-lab table indoor_robustness --fit` does it. Those of tones were fitted
    later, to windows with depth and colours and their wrong rivals; the others stayed as they were, so
    that what one sense alone says is what it was.
    """

    level: float
    depth: tuple[float, float, float]
    """That depth is there; log odds of its share that agrees; the log of how firmly surfaces hold the
    pose, as far as depth speaks alone."""
    colour: tuple[float, float]
    """That colours are there; what their steps tell [1 / nat]."""
    tone: tuple[float, float]
    """That they stand beside depth; what they tell themselves [1 / nat]."""

    @property
    def coefficients(self) -> tuple[float, ...]:
        """(8,) what stands before `features`."""
        return (self.level, *self.depth, *self.colour, *self.tone)

    def tone_odds(self, tone: float) -> float:
        """Log odds that tones add which tell so much [nat]."""
        return self.tone[0] + self.tone[1] * min(max(tone, 0.0), _MOST_TONE)

    def odds(self, agreed: Agreement) -> float:
        """Log odds; minus infinity where there is neither depth nor colour."""
        if np.isnan(agreed.depth) and np.isnan(agreed.colour):
            return -np.inf
        return float(np.dot(self.coefficients, features(agreed)))

    def probability(self, agreed: Agreement, probability: float) -> float:
        """Probability that a pose is right which is the best with a probability."""
        return probability / (1.0 + float(np.exp(-self.odds(agreed))))


def features(agreed: Agreement) -> list[float]:
    """(8,) what the coefficients of `ConfidenceModel` stand before."""
    depth = [0.0, 0.0, 0.0]
    if not np.isnan(agreed.depth):
        bare = _alone(agreed) * float(np.log(agreed.held + _SLIM))
        depth = [1.0, log_odds(agreed.depth, 0.01), bare]
    colour = [0.0, 0.0]
    if not np.isnan(agreed.colour):
        colour = [1.0, float(np.clip(agreed.colour, 0.0, _MOST_COLOUR))]
    tone = [0.0, 0.0]
    if not np.isnan(agreed.tone):
        tone = [1.0, float(np.clip(agreed.tone, 0.0, _MOST_TONE))]
    return [1.0, *depth, *colour, *tone]


def _alone(agreed: Agreement) -> float:
    """How far depth speaks alone, 0 to 1: clear colours lift it, and several objects that tell."""
    colour = 0.0 if np.isnan(agreed.colour) else (agreed.colour - SPEAK) / (CLEAR - SPEAK)
    named = 0.0 if np.isnan(agreed.semantic) else np.clip(agreed.weights / TELLING, 0.0, 1.0).sum()
    lifted = np.clip([colour, named / WITNESSES], 0.0, 1.0)
    return float(np.prod(1.0 - lifted))


def log_odds(share: float, least: float) -> float:
    """Log odds of a share, no nearer to 0 and 1 than `least`."""
    share = min(max(share, least), 1.0 - least)
    return float(np.log(share / (1.0 - share)))


CONFIDENCE = ConfidenceModel(
    level=6.44, depth=(-3.0, 1.77, 2.26), colour=(-5.54, 31.36), tone=(2.12, 21.28)
)


_NAMED = 12  # objects named


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How far a pose and what was seen agree, in numbers between 0 and 1."""

    covered: float
    """Share of the samples at which the map has something."""
    semantic: float
    """Of patches that see the map and say something, the share that fit; NaN: no patches."""
    depth: float
    """Of readings where the map has a surface, the share within one deviation; NaN: none."""
    colour: float
    """Mean log-likelihood of the steps of colour per independent pair [nat]; NaN: no colours."""
    weights: Floats
    """(N,) what the patches and readings that concern each object told for the pose [nat]."""
    told: Floats
    """(N,) how many patches or readings concern each object."""
    ratio: float = 0.0
    """Log-likelihood ratio of what is seen against anywhere in the map, a frame [nat]."""
    held: float = 0.0
    """How firmly surfaces hold the position, 0 to 1/3: of the readings that lie on them, the share
    whose surface faces the direction that fewest do. A blank wall and the floor: 0."""
    tone: float = np.nan
    """Mean log-likelihood of the colours themselves, beside depth, per independent sample [nat]; NaN:
    no colours, or no depth."""
    frames: Floats = field(default_factory=lambda: np.full((0, 3), np.nan))
    """(T, 3) how far each frame by itself agrees: semantic, depth, colour."""

    def numbers(self) -> dict[str, float | None]:
        """What a verdict is made of, ready for `json.dumps`; None: there is no such sense."""
        names = ("covered", "semantic", "depth", "colour", "tone", "ratio", "held")
        values = {name: float(getattr(self, name)) for name in names}
        values["witnesses"] = float((self.weights > TELLING).sum())
        values["odds"] = CONFIDENCE.odds(self)
        return {name: value if np.isfinite(value) else None for name, value in values.items()}


def agreement(scorer: Scorer, pose: Floats, views: Sequence[View], steps: Floats) -> Agreement:
    """Agreement of a pose (4,) of the reference frame with all frames of the window."""
    scene, noise = scorer.scene, scorer.model.noise
    count = len(scene)
    weights, told = np.zeros(count), np.zeros(count)
    samples = hits = 0
    fits = np.zeros((len(views), 4, 2))
    total, faced = 0.0, np.zeros((3, 3))
    for fit, view, step in zip(fits, views, steps, strict=True):
        at = compose(pose, step)
        triangles, distances = look(scene.caster.tracer, at, view.directions)
        used = view.patch >= 0
        hit = used & (triangles >= 0)
        samples, hits = samples + int(used.sum()), hits + int(hit.sum())
        objects = np.where(triangles >= 0, scene.mesh.object_of[triangles], count)
        if view.terms[SEMANTIC]:
            size = len(view.weight)
            ratio = view.semantic[view.patch, objects]
            mean = np.bincount(view.patch[used], ratio[used], size)
            shares = np.bincount(view.patch[used], minlength=size)
            said = (view.weight > 0) & (np.bincount(view.patch[hit], minlength=size) > 0)
            logs = np.log(np.maximum(mean[said] / shares[said], 1e-6))
            fit[SEMANTIC] = (logs > 0).sum(), said.sum()
            about = _concerned(view.semantic[:, :count], view.patch[hit], objects[hit], said, logs)
            np.add.at(weights, about, logs * view.weight[said])
            np.add.at(told, about, 1.0)
        if view.terms[DEPTH]:
            read = hit & (view.depth > 0)
            error = distances[read] - view.depth[read]
            sd = noise.depth_floor + noise.depth_slope * view.depth[read]
            ratio = reading_ratio(error, sd, noise) - view.usual_depth[read]
            lies = np.abs(error) < sd
            fit[DEPTH] = lies.sum(), read.sum()
            normals = scene.normals[triangles[read][lies]]
            faced += normals.T @ normals
            share = noise.depth_weight / max(1, int(used.sum()))
            np.add.at(weights, objects[read], ratio * share)
            np.add.at(told, objects[read], share)
        scores = scorer.terms(at[None], view)[0].astype(np.float64)
        total += float(scores.sum())
        if view.terms[COLOUR]:
            share = float(hit.sum()) / used.sum()
            fit[COLOUR] = scores[COLOUR], max(1e-9, noise.colour_weight * share)
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
            weights=weights,
            told=told,
            ratio=total / max(1, len(views)),
            held=float(np.linalg.eigvalsh(faced)[0] / max(1.0, np.trace(faced))),
            frames=fits[:, :TONE, 0] / fits[:, :TONE, 1],
        )


def _concerned(
    semantic: NDArray[np.float32],
    patch: NDArray[np.int32],
    objects: NDArray[np.int32],
    said: NDArray[np.bool_],
    logs: Floats,
) -> NDArray[np.int64]:
    """Object that each patch in `said` speaks for or against, by what it sees: `objects` of hits.

    A patch that fits speaks for the object that it sees; one that does not, against the one that it
    named. Where it named several (all chairs of a map), it speaks against what the map shows there.
    """
    size, count = semantic.shape
    pairs = patch * np.int64(count) + objects
    sums = np.bincount(pairs, semantic[patch, objects], size * count).reshape(size, count)
    seen = np.bincount(pairs, minlength=size * count).reshape(size, count)
    named = semantic.argmax(axis=1)
    several = (semantic == semantic.max(axis=1, keepdims=True)).sum(axis=1) > 1
    blamed = np.where(several, seen.argmax(axis=1), named)
    return np.asarray(np.where(logs > 0, sums.argmax(axis=1)[said], blamed[said]))


def explain(scene: Scene, agreed: Agreement) -> tuple[Evidence, ...]:
    """Evidence in words, the heaviest first."""
    order = np.argsort(-np.abs(agreed.weights), kind="stable")
    rows = order[agreed.told[order] > 0][:_NAMED].tolist()
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
                note="edges correlate with the map's"
                if agreed.colour > SPEAK
                else "edges hardly correlate with the map's",
            )
        )
    if agreed.covered < 0.75:
        out.append(
            Evidence(
                "coverage", "silent", 0.0,
                note=f"the map ends in {1.0 - agreed.covered:.0%} of what the frames see",
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
        note="" if verdict != "against" else "not where the map has it",
    )
