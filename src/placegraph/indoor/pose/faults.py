"""Diagnosis of faulty input: frames that fit no map, and faults that explain why frames do not fit.

Each fault has a row in the table *Bad input* of docs/benchmarks/indoor-robustness.md, which the function
that looks for it names.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, level_from_camera, wrap_angle
from placegraph.indoor.likelihood.observe import FINE, Sighting
from placegraph.indoor.pose.agreement import SPEAK, agreement
from placegraph.indoor.pose.local_fit import fit_window
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import Window

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
_STARTS = 8
_GAIN, _LEAST_RATIO = 1.2, 25.0
"""Least gain of the log-likelihood ratio by undoing a fault, and least ratio of a frame [nat]."""
_UNDERGROUND = (-1.0, -0.3)
"""Heights above the floor at which a camera below it is searched for [m]."""


def find_image_fault(window: Window) -> str:
    """Return the fault of images that fit no map, as a sentence; empty: none.

    Rows *lens cap* and *frozen image*.
    """
    others = any(s.depth is not None or s.patches is not None for s in window.sightings)
    if not others and all(s.rgb is not None and _is_blank(s.rgb) for s in window.sightings):
        return (
            "The lens seems to be covered: no image shows anything, and there is no depth. "
            "Uncover it, or check the camera's output."
        )
    frozen = _find_frozen_run(window)
    if frozen is None:
        return ""
    first, last = (window.sightings[i].frame.index for i in frozen)
    return (
        f"The images are frozen: frames {first} to {last} are the same, although the camera "
        "moved by its odometry. Restart the camera, or leave repeated frames out."
    )


def _is_blank(rgb: NDArray[np.uint8]) -> bool:
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
        if i <= last and _have_equal_image(window.sightings[i - 1], window.sightings[i]):
            continue
        ends_now, count = i - 1 == last, i - start
        if count > 1 and (count > 2 or ends_now) and _has_moved(window.poses[start:i]):
            found = max(found or (start, start), (start, i - 1), key=lambda run: run[1] - run[0])
        start = i
    return found


def _have_equal_image(one: Sighting, other: Sighting) -> bool:
    """Return whether two frames have an equal image: the noise of sensors lets no image repeat.

    Blank images prove nothing: a covered lens may be free of noise.
    """
    pairs = ((one.rgb, other.rgb), (one.depth, other.depth))
    return any(
        a is not None
        and b is not None
        and a.shape == b.shape
        and np.array_equal(a[::7, ::5], b[::7, ::5], equal_nan=a.dtype.kind == "f")
        and not (a.dtype == np.uint8 and _is_blank(a))
        for a, b in pairs
    )


def _has_moved(poses: Floats) -> bool:
    """Return whether poses (T, 4) of odometry moved or turned over their run."""
    way = np.linalg.norm(poses[-1, :3] - poses[0, :3])
    turn = np.abs(wrap_angle(poses[:, 3] - poses[0, 3])).max()
    return bool(way > _MOVED or turn > _TURNED)


def find_contradiction(window: Window, frames: Floats) -> str:
    """Return how frames of a window contradict each other by their odometry, as a sentence; empty: not.

    A frame that fits and one that does not cannot both have been taken where odometry says. Rows *half
    elsewhere* and *no odometry*; of images without depth, the rows *colour alone* of absent scenes.

    Parameters
    ----------
    frames
        (T, 3) agreement of each frame with one trajectory (`Agreement.frames`).

    """
    if _is_odometry_missing(window.sightings):
        return (
            "The odometry stands still, although the camera moved by its depth: give its odometry, or "
            "localize each frame by itself."
        )
    depth, colour = frames[:, 1], frames[:, 2]
    by_images = np.isnan(depth) & np.isnan(frames[:, 0])
    by_images &= [s.rgb is not None and not _is_blank(s.rgb) for s in window.sightings]
    misses = np.where(by_images, colour < _MUTE, (depth < _MISSES) & ~(colour > SPEAK))
    fits = np.where(by_images, colour > SPEAK, depth > _FITS)
    few = misses.sum() < max(2, round(0.3 * len(depth)))
    if fits.sum() < 2 or (few and not (by_images & misses)[-1]):
        return ""
    rows = [window.sightings[i].frame.index for i in np.flatnonzero(misses)]
    listed = ", ".join(map(str, rows[:6])) + (", ..." if len(rows) > 6 else "")
    return (
        f"Frames {listed} contradict the others: they were taken elsewhere, or the odometry "
        "jumped. Localize each part by itself."
    )


def _is_odometry_missing(sightings: list[Sighting]) -> bool:
    """Return whether odometry is one pose, although half of the depth readings changed."""
    first, last = sightings[0].depth, sightings[-1].depth
    if len(sightings) < 2 or first is None or last is None or first.shape != last.shape:
        return False
    change = np.abs(first[::7, ::5] - last[::7, ::5])
    read = np.isfinite(change)
    still = np.ptp([s.frame.odometry for s in sightings], axis=0).max() < _STILL
    return bool(still and read.any() and np.median(change[read]) > _MOVED)


def find_fault(window: Window, ratio: float, rng: Generator) -> str:
    """Return the fault of the input that explains why frames do not fit, as a sentence; empty: none.

    Frames with depth are searched for in the whole map with one fault after the other undone.

    Parameters
    ----------
    ratio
        Log-likelihood ratio against anywhere of the frames as they are, a frame [nat].

    """
    if all(s.depth is None for s in window.sightings):
        return ""
    for corrected, sentence in _undo_faults(window):
        if not len(corrected.table):
            continue
        fit = fit_window(corrected, search(corrected, rng)[:_STARTS], rng)[0]
        judging, newest = corrected.judging, corrected.newest
        views = [judging.views(FINE)[i] for i in newest]
        agreed = agreement(judging.scorer, fit.pose, views, between(fit.pose, fit.poses[newest]))
        if agreed.depth > _FITS and agreed.ratio > max(_LEAST_RATIO, _GAIN * ratio):
            return sentence
    return ""


def _undo_faults(window: Window) -> Iterator[tuple[Window, str]]:
    """Yield the window with one fault undone, and a sentence about the fault.

    Rows *gravity up*, *mirrored* and *below the floor*.
    """
    query, sightings = replace(window.query, prior=None), window.sightings
    if np.mean([s.frame.gravity[1] for s in sightings]) < 0:  # or the camera is held upside down
        upright = [_turn_gravity_round(s) for s in sightings]
        yield (
            Window(query, window.scorer, upright),
            (
                "With gravity turned round they fit: gravity seems to point up. Give the direction in which "
                "things fall; an accelerometer at rest measures the opposite."
            ),
        )
    yield (
        Window(query, window.scorer, [_mirror(s) for s in sightings]),
        (
            "Mirrored they fit: left and right of the images seem to be swapped. Give images as the camera "
            "sees them."
        ),
    )
    below = replace(query, options=replace(query.options, heights=_UNDERGROUND))
    yield (
        Window(below, window.scorer, sightings),
        (
            "They fit a camera below the floor of the map: check which storey this is, and the map's floor."
        ),
    )


def _turn_gravity_round(sighting: Sighting) -> Sighting:
    frame = replace(sighting.frame, gravity=-sighting.frame.gravity)
    return replace(sighting, frame=frame, level=level_from_camera(frame.gravity))


def _mirror(sighting: Sighting) -> Sighting:
    patches, depth, rgb = sighting.patches, sighting.depth, sighting.rgb
    if patches is not None:
        patches = replace(patches, rows=patches.rows.reshape(patches.grid)[:, ::-1].ravel())
    return replace(
        sighting,
        patches=patches,
        depth=None if depth is None else np.ascontiguousarray(depth[:, ::-1]),
        rgb=None if rgb is None else np.ascontiguousarray(rgb[:, ::-1]),
    )
