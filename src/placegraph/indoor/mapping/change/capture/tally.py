"""Object by object, what speaks for "it is still there" and what for "it is gone".

By depth: a ray that goes on where the map has the object speaks against it, one that ends there
for it; it counts where the next surface behind the object is so far that noise cannot mix the two
up. Where it is not, as of a picture on a wall, colours decide: those of the object and those behind
it, both brought to the light that falls on their surroundings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.change.capture.looks import Look
from placegraph.indoor.mapping.change.options import DiffOptions
from placegraph.indoor.rays import RayCaster

Mask = NDArray[np.bool_]


RING = 7
"""Width of the surroundings of an object that tell the light on it [px]."""
_RING_PIXELS = 30
_CONTRAST = 0.08
"""Colours of object and background that differ less than this cannot be told apart (0 to 1)."""
_SPEAKING = 0.1
"""Share of `least_pixels` in a frame from which on it counts as a frame that speaks."""
_FLAT = 0.6
"""Colours decide where they can tell at this share of an object's pixels or more."""


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """T frames, N objects."""

    gone: Floats
    """(T, N) pixels that speak for being gone."""
    stays: Floats
    """(T, N) pixels that speak for being there."""
    by_colour: NDArray[np.bool_]
    """(N,) whether these pixels were judged by colour."""
    least: tuple[int, int]
    """Pixels in all and frames that are needed."""

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N,) whether enough pixels of enough frames speak of an object."""
        pixels = self.gone + self.stays
        frames = np.count_nonzero(pixels >= _SPEAKING * self.least[0], axis=0)
        return (pixels.sum(axis=0) >= self.least[0]) & (frames >= self.least[1])

    @property
    def share(self) -> Floats:
        """(N,) share of the pixels that speak for being gone."""
        gone = self.gone.sum(axis=0)
        return np.asarray(gone / np.maximum(gone + self.stays.sum(axis=0), 1.0))

    def confidence(self, row: int) -> float:
        """How sure it is that an object is gone: the rule of succession over frames.

        Pixels of one frame are right or wrong together, so a frame counts once, by its share.
        """
        pixels = self.gone[:, row] + self.stays[:, row]
        weight = np.minimum(pixels / (2.0 * _SPEAKING * self.least[0]), 1.0)
        share = self.gone[:, row] / np.maximum(pixels, 1.0)
        return float((np.sum(weight * share) + 0.5) / (np.sum(weight) + 1.0))


def tally(looks: Sequence[Look], count: int, options: DiffOptions) -> Tally:
    """What all frames say of `count` objects."""
    depth_gone, depth_stays, colour_gone, colour_stays = np.zeros((4, len(looks), count))
    for t, look in enumerate(looks):
        agrees = np.isfinite(look.front.depth)
        flat = agrees
        if look.depth is not None:
            slack = tolerance(look.depth, options)
            near, far = around(look.front.depth)
            with np.errstate(invalid="ignore"):
                agrees = (look.depth >= near - slack) & (look.depth <= far + slack)
                apart = look.behind.depth - look.front.depth > 2.0 * slack
                even = far - near < 2.0 * slack + 0.1
                through = (look.depth > far + slack) & apart & even
            depth_gone[t] = _count(look, through, count)
            depth_stays[t] = _count(look, agrees & apart & even, count)
            flat = agrees & ~apart
        if options.colour:
            _by_colour(look, flat, agrees, colour_gone[t], colour_stays[t])
    by_depth = (depth_gone + depth_stays).sum(axis=0)
    by_colour = (colour_gone + colour_stays).sum(axis=0)
    flat_ones = by_colour > _FLAT * (by_depth + by_colour)
    least = options.least_pixels, min(options.least_frames, len(looks))
    return Tally(
        np.where(flat_ones, colour_gone, depth_gone),
        np.where(flat_ones, colour_stays, depth_stays),
        flat_ones,
        least,
    )


def tolerance(depth: NDArray[np.float32], options: DiffOptions) -> NDArray[np.float32]:
    """How far a reading may be from what it shows [m]."""
    slack = options.depth_floor + options.depth_slope * np.nan_to_num(depth)
    return np.asarray(slack, np.float32)


def around(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Least and largest value (H, W) of each pixel and its eight neighbours."""
    padded = np.pad(image, 1, mode="edge")
    h, w = image.shape
    parts = [padded[i : i + h, j : j + w] for i in range(3) for j in range(3)]
    return np.minimum.reduce(parts), np.maximum.reduce(parts)


def grown(mask: Mask, by: int) -> Mask:
    """Mask with all pixels up to `by` rows and columns away."""
    return summed(mask, by) > 0


def summed(mask: NDArray[np.generic], by: int) -> NDArray[np.float64]:
    """Sum (H, W) over the square of pixels up to `by` rows and columns away."""
    total = np.pad(mask.astype(np.float64), ((by + 1, by), (by + 1, by)))
    total = total.cumsum(axis=0).cumsum(axis=1)
    k = 2 * by + 1
    return np.asarray(total[k:, k:] - total[:-k, k:] - total[k:, :-k] + total[:-k, :-k])


def light(look: Look, where: Mask) -> Floats | None:
    """(3,) what the map's colours have to be multiplied with at pixels; None of too few."""
    where = where & np.isfinite(look.rgb[..., 0])
    if np.count_nonzero(where) < _RING_PIXELS:
        return None
    ratio = look.rgb[where] / np.maximum(look.front.colour[where], 0.02)
    return np.asarray(np.median(ratio, axis=0), np.float64)


def _by_colour(look: Look, flat: Mask, agrees: Mask, gone: Floats, stays: Floats) -> None:
    """Write pixels (N,) for and against every object that colours can tell from its background."""
    objects = look.front.objects
    usable = flat & (objects >= 0) & np.isfinite(look.rgb[..., 0]) & (look.behind.objects >= 0)
    for row in np.unique(objects[usable]).tolist():
        own = objects == row
        here = usable & own
        if np.count_nonzero(here) < _RING_PIXELS:
            continue
        lit = light(look, grown(own, RING) & ~own & agrees & (objects >= 0))
        if lit is None:
            continue
        there, behind = look.front.colour[here] * lit, look.behind.colour[here] * lit
        telling = np.abs(there - behind).mean(axis=1) > _CONTRAST
        seen = look.rgb[here][telling]
        off_there, off_behind, apart = (
            np.abs(a - b).sum(axis=1)
            for a, b in (
                (seen, there[telling]), (seen, behind[telling]), (there[telling], behind[telling])
            )
        )  # fmt: skip
        # 1 where the colour is that of the background, 0 where it is the thing's, between between
        closer = 0.5 + 0.5 * (off_there - off_behind) / apart
        gone[row], stays[row] = closer.sum(), (1.0 - closer).sum()


def _count(look: Look, mask: Mask, count: int) -> Floats:
    rows = look.front.objects[mask]
    return np.asarray(np.bincount(rows[rows >= 0], minlength=count), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """What is left of the map without all that is suspected to be gone, frame by frame."""

    looks: Sequence[Look]
    depths: Sequence[NDArray[np.float32]]
    """T arrays (H, W) of the depth of what is left [m]; inf: nothing."""
    new: Sequence[NDArray[np.bool_]]
    """T masks (H, W) of readings that end before it: nothing explains them yet."""
    options: DiffOptions


def rest_of(
    scene: Scene, looks: Sequence[Look], suspects: NDArray[np.int64], options: DiffOptions
) -> Rest:
    """The map without the suspects, and what it does not explain."""
    suspected = np.zeros(len(scene) + 1, np.bool_)
    suspected[suspects] = True
    mesh = scene.mesh
    kept = ~suspected[mesh.object_of]
    caster = RayCaster(mesh.vertices, mesh.triangles[kept]) if kept.any() else None
    depths, new = [], []
    for seen in looks:
        depth = seen.front.depth.copy()
        gone = suspected[seen.front.objects]
        if gone.any():
            origin = seen.map_from_camera[:3, 3]
            rays = seen.rays[gone]
            depth[gone] = caster.cast(origin, rays).distance if caster else np.inf
        depths.append(depth)
        new.append(_new(seen, depth, options))
    return Rest(looks, depths, new, options)


def _new(seen: Look, depth: NDArray[np.float32], options: DiffOptions) -> NDArray[np.bool_]:
    """(H, W) readings that end before all surfaces around, and are not alone in it."""
    if seen.depth is None:
        return np.zeros(depth.shape, np.bool_)
    near, _ = around(depth)
    with np.errstate(invalid="ignore"):
        before = seen.depth < near - tolerance(seen.depth, options)
    before &= np.isfinite(depth)  # beyond the map's end nothing is known to be new
    return before & (summed(before, 1) >= 5)


def shown(looks: Sequence[Look], count: int, options: DiffOptions) -> NDArray[np.bool_]:
    """(N,) whether readings that agree with the map end on an object."""
    pixels = np.zeros(count)
    for seen in looks:
        agrees = seen.front.objects >= 0
        if seen.depth is not None:
            with np.errstate(invalid="ignore"):
                off = np.abs(seen.depth - seen.front.depth)
                agrees &= off <= tolerance(seen.depth, options)
        pixels += np.bincount(seen.front.objects[agrees], minlength=count)
    return pixels >= options.least_pixels
