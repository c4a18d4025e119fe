"""What is wrong with the input: named, so that it can be mended.

`spoiled` looks at frames alone, and costs next to nothing. `suspected` is asked where no pose is sure: it
supposes one fault after the other, takes it back, and sees whether the frames then fit the map.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, level_from_camera, split_pose, wrap_angle
from placegraph.indoor.likelihood.observe import (
    FINE,
    Sighting,
    mended,
    sight,
    spread,
    suspected_factor,
)
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.pose.agreement import SPEAK, agreement
from placegraph.indoor.pose.local_fit import fit_window
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import PoseQuery, Window

_FLAT = 2.0
"""Deviation of the means of an image's blocks, of 255 steps, below which it shows nothing."""
_MOVED, _TURNED = 0.1, 0.1
"""Way [m] and turn [rad] over which no two images are the same."""
_STILL = 1e-6
"""Odometry whose matrices change by less is no estimate: those that stand drift by more."""
_BLOCKS = (8, 12)
_FITS, _MISSES = 0.75, 0.5
"""Share of depth readings on the map's surfaces of frames that fit, and of frames that do not."""
_MUTE = SPEAK / 4.0
"""What colours tell at most of a frame taken elsewhere [nat a sample]."""
_STARTS = 8
_SOME = 12
"""Frames of a long capture that are looked at."""
_GAIN, _TELLS = 1.2, 25.0
"""A fault taken back must make frames fit so many times as well, and tell so much a frame [nat]."""
_FILLED = 0.67
"""Share of the views that the map must cover for another factor of depth: near enough, anything fits."""
_PERHAPS = 0.2
"""What a factor of depth must gain to be tried, though others may be as usual [nat a reading]."""
_COLOURS_FIT = 0.05
"""What colours tell of frames that fit, where there is no depth [nat a sample]."""


_NOT_THERE = (
    "Without the prior they fit: the first frame was not taken there. Check its x, y and z, which are in "
    "the map's frame, or leave it out."
)
_UPSIDE_DOWN = (
    "With gravity turned round they fit: it seems to point up. Give the direction in which things "
    "fall; an accelerometer at rest measures the opposite."
)
_LEFT_IS_RIGHT = (
    "Mirrored they fit: left and right of the images seem to be changed. Give them as the camera "
    "sees them."
)

COVERED = "No image shows anything: the lens seems to be covered, and images were left out."
"""What is said where the other senses answer without them."""
_OUTSIDE = "They fit a camera {} of the map: check which storey this is, and the map's floor."


def find_spoiled(window: Window) -> str:
    """What is wrong with frames whatever the map is, in a sentence; empty: nothing."""
    if _covered(window.sightings):
        return (
            "The lens seems to be covered: no image shows anything, and there is no depth. "
            "Uncover it, or check what the camera delivers."
        )
    stuck = _stuck(window)
    if stuck:
        first, last = (window.sightings[i].frame.index for i in stuck)
        return (
            f"The images are frozen: frames {first} to {last} are the same, although the camera "
            "moved by its odometry. Restart the camera, or leave repeated frames out."
        )
    return ""


def _covered(sightings: list[Sighting]) -> bool:
    """Whether all images are flat, and no frame has depth or labels."""
    bare = not any(s.depth is not None or s.patches for s in sightings)
    return bare and is_blank(sightings)


def is_blank(sightings: list[Sighting]) -> bool:
    """Whether no image shows anything."""
    return all(s.rgb is not None and _flat(s.rgb) for s in sightings)


def _flat(rgb: NDArray[np.uint8] | NDArray[np.float32]) -> bool:
    """Whether an image (H, W, 3) has no contrast but its pixels' noise."""
    rows, columns = (n // k * k for n, k in zip(rgb.shape, _BLOCKS, strict=False))
    some = rgb[:rows:2, :columns:2].astype(np.float32).mean(axis=2)
    height, width = (n // k for n, k in zip(some.shape, _BLOCKS, strict=True))
    some = some[: height * _BLOCKS[0], : width * _BLOCKS[1]]
    means = some.reshape(_BLOCKS[0], height, _BLOCKS[1], width).mean(axis=(1, 3))
    return bool(means.std() < _FLAT)


def _stuck(window: Window) -> tuple[int, int] | None:
    """First and last row of the longest run of frames with one image over which the camera moved.

    Two alike among many are a frame that was sent twice, except at the end, where the answer is.
    """
    found, start, last = None, 0, len(window) - 1
    for i in range(1, len(window) + 1):
        if i <= last and _same(window.sightings[i - 1], window.sightings[i]):
            continue
        ends_now, count = i - 1 == last, i - start
        if count > 1 and (count > 2 or ends_now) and _moved(window.poses, start, i - 1):
            found = max(found or (start, start), (start, i - 1), key=lambda run: run[1] - run[0])
        start = i
    return found


def _same(one: Sighting, other: Sighting) -> bool:
    """Whether two frames have an image in common: sensors' noise lets none repeat itself.

    Images that show nothing prove nothing: a covered lens may be free of noise.
    """
    pairs = ((one.rgb, other.rgb), (one.depth, other.depth))
    return any(
        a is not None
        and b is not None
        and a.shape == b.shape
        and np.array_equal(a[::7, ::5], b[::7, ::5], equal_nan=a.dtype.kind == "f")
        and not (a.ndim == 3 and _flat(a))
        for a, b in pairs
    )


def _moved(poses: Floats, first: int, last: int) -> bool:
    way = np.linalg.norm(poses[last, :3] - poses[first, :3])
    turn = np.abs(wrap_angle(poses[first : last + 1, 3] - poses[first, 3])).max()
    return bool(way > _MOVED or turn > _TURNED)


def find_divided(window: Window, frames: Floats) -> str:
    """Which frames contradict the others, in a sentence; empty: they agree.

    `frames`: (T, 3) how far each agrees with one pose of the window (`Agreement.frames`).

    A frame that fits and one that does not cannot both have been taken where odometry says.
    """
    depth, colour = frames[:, 1], frames[:, 2]
    alone = np.isnan(depth) & np.isnan(frames[:, 0])
    pairs = zip(alone, window.sightings[-len(frames) :], strict=True)
    # frames of which images alone say where they are
    images = np.array([one and s.rgb is not None and not _flat(s.rgb) for one, s in pairs])
    misses = np.where(images, colour < _MUTE, (depth < _MISSES) & ~(colour > SPEAK))
    fit = np.where(images, colour > SPEAK, depth > _FITS)
    few = misses.sum() < max(2, round(0.3 * len(depth)))
    if fit.sum() < 2 or (few and not (images & misses)[-1]):
        return ""
    rows = [window.sightings[i].frame.index for i in np.flatnonzero(misses)]
    listed = ", ".join(map(str, rows[:6])) + (", ..." if len(rows) > 6 else "")
    return (
        f"Frames {listed} contradict the others: they were taken elsewhere, or the odometry "
        "jumped. Localize each part by itself."
    )


def find_unmoved(sightings: Sequence[Sighting]) -> str:
    """That odometry is one pose all along, as where it is missing, though most of the depth moved."""
    first, last = sightings[0].depth, sightings[-1].depth
    if len(sightings) < 2 or first is None or last is None or first.shape != last.shape:
        return ""
    change = np.abs(first[::7, ::5] - last[::7, ::5])
    read = np.isfinite(change)
    still = np.ptp([s.frame.odometry for s in sightings], axis=0).max() < _STILL
    if not (still and read.any() and np.median(change[read]) > _MOVED):
        return ""
    return (
        "The odometry stands still, although the camera moved by its depth: give its odometry, or "
        "localize each frame by itself."
    )


def find_divided_capture(query: PoseQuery, scorer: Scorer, trajectory: Floats) -> str:
    """`find_divided` of a long capture by its trajectory (T, 4, 4) and some of its frames."""
    rows = spread(len(trajectory), _SOME)
    seen = [sight(query.frames[i], query.encoder, query.options) for i in rows.tolist()]
    window, (poses, _) = Window(query, scorer, seen), split_pose(trajectory[rows])
    steps = between(poses[-1], poses)
    judging = window.judging
    return find_divided(
        window, agreement(judging.scorer, poses[-1], judging.views(FINE), steps).frames
    )


# ------------------------------------------------------------------------------------ hypotheses


def find_fault(window: Window, ratio: float, rng: Generator) -> str:
    """The fault of the input that explains why frames do not fit, in a sentence; empty: none does.

    `ratio`: log-likelihood ratio against anywhere that the frames reached as they are, a frame [nat].
    """
    for other, said, least in _faults(window):
        if not len(other.table):
            continue
        seeds = search(other, rng)
        fit = fit_window(other, seeds[:_STARTS], rng)[0]
        judging, looked = other.judging, other.newest
        views = [judging.views(FINE)[i] for i in looked]
        agreed = agreement(judging.scorer, fit.pose, views, between(fit.pose, fit.poses[looked]))
        fits = agreed.colour > _COLOURS_FIT if np.isnan(agreed.depth) else agreed.depth > _FITS
        if fits and agreed.covered > least and agreed.ratio > max(_TELLS, _GAIN * ratio):
            return said
    return ""


def _faults(window: Window) -> Iterator[tuple[Window, str, float]]:
    """Windows with a fault taken back, looked for in all of the map; what it is; least coverage."""
    query, sightings, scene = replace(window.query, prior=None), window.sightings, window.scene

    def changed(asked: PoseQuery = query, frames: list[Sighting] = sightings) -> Window:
        return Window(asked, window.scorer, frames)

    if window.query.prior is not None:
        yield changed(), _NOT_THERE, 0.0
    if np.mean([s.frame.gravity[1] for s in sightings]) < 0:  # or held upside down
        yield changed(frames=[_turned_round(s) for s in sightings]), _UPSIDE_DOWN, 0.0
    yield changed(frames=[_mirrored(s) for s in sightings]), _LEFT_IS_RIGHT, 0.0
    factor = suspected_factor(window.views(FINE), window.table.background, _PERHAPS)
    if factor is not None:
        said = f"Scaled they fit. {mended(sightings[-1].frame, factor)}"
        yield changed(frames=[_divided(s, factor) for s in sightings]), said, _FILLED
    top = float(scene.bounds[1, 2] - scene.floors.max())
    outside = {"below the floor": (-1.0, -0.3), "above the ceiling": (top + 0.2, top + 0.9)}
    for where, heights in outside.items():
        options = replace(query.options, heights=heights)
        yield changed(replace(query, options=options)), _OUTSIDE.format(where), 0.0


def _turned_round(sighting: Sighting) -> Sighting:
    frame = replace(sighting.frame, gravity=-sighting.frame.gravity)
    return replace(sighting, frame=frame, level=level_from_camera(frame.gravity))


def _divided(sighting: Sighting, factor: float) -> Sighting:
    depth = sighting.depth
    return replace(sighting, depth=None if depth is None else depth / np.float32(factor))


def _mirrored(sighting: Sighting) -> Sighting:
    patches, depth, rgb = sighting.patches, sighting.depth, sighting.rgb
    if patches is not None:
        patches = replace(patches, rows=patches.rows.reshape(patches.grid)[:, ::-1].ravel())
    return replace(
        sighting,
        patches=patches,
        depth=None if depth is None else np.ascontiguousarray(depth[:, ::-1]),
        rgb=None if rgb is None else np.ascontiguousarray(rgb[:, ::-1]),
    )
