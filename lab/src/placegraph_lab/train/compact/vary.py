"""What a camera, a map and chance make of a scene, drawn anew each time it is shown.

Surfaces change their colour in picture and map alike, which multiplies the light of every pixel of
an object; cameras have their own exposure, white balance, tone and noise; maps have theirs, with
colours that hold some of the light they were recorded in, or are blurred, and may lack labels.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.encode.compact.picture import log_light

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.encode.compact.things import Things

    Floats = NDArray[np.float32]

REPAINTED = 0.5
"""Share of objects that get another colour, in scenes where any do."""


def paint(count: int, rng: np.random.Generator) -> Floats:
    """Factors (count, 3) of the light of objects: 1 where they keep their colour."""
    factors = np.ones((count, 3), np.float32)
    if rng.random() < 0.7:
        new = rng.random(count) < REPAINTED
        lightness = rng.normal(0.0, 0.45, (count, 1))
        drawn = np.exp(lightness + rng.normal(0.0, 0.4, (count, 3)))
        factors[new] = np.minimum(drawn, 3.0)[new]
    return factors


def photographed(light: Floats, rng: np.random.Generator) -> Floats:
    """`picture.log_light` (H, W, 3) of what some camera makes of linear light (H, W, 3)."""
    h, w = light.shape[:2]
    light = light * _field((h, w), rng.uniform(0.0, 0.4), rng)[..., None]
    if rng.random() < 0.3:
        light = _blurred(light)
    light = light * np.exp(rng.normal(0.0, 0.12, 3)).astype(np.float32)  # white balance
    grey = light.mean(axis=2, keepdims=True)
    light = np.maximum(grey + (light - grey) * np.float32(rng.uniform(0.6, 1.3)), 0.0)
    level = float(np.exp(np.log(light[::4, ::4].mean(axis=2) + 1e-3).mean()))
    light = light * np.float32(0.3 * np.exp(rng.normal(0.0, 0.45)) / level)
    light = np.float32(1.0) - np.exp(-light) if rng.random() < 0.6 else np.minimum(light, 1.0)
    light = light ** np.float32(np.exp(rng.normal(0.0, 0.15)))
    light += rng.uniform(0.0, 0.02) * (rng.random() < 0.3)  # a veil of stray light
    noise = rng.uniform(0.002, 0.02) * np.sqrt(light + 0.02)
    light = light + noise * rng.standard_normal(light.shape, np.float32)
    return log_light(np.clip(light, 0.0, 1.0))


def strewn(
    log: Floats, patches: NDArray[np.integer], pixels: int, rng: np.random.Generator
) -> NDArray[np.integer]:
    """Patches (rows, columns) that still show their object; -1 where things of no map stand before.

    `log`: (pixels * rows, pixels * columns, 3), changed in place.
    """
    patches = patches.copy()
    h, w = log.shape[:2]
    for _ in range(rng.integers(0, 4)):
        y, x = rng.integers(h), rng.integers(w)
        tall, wide = rng.integers(8, h // 2), rng.integers(8, w // 3)
        box = log[y : y + tall, x : x + wide]
        if rng.random() < 0.5:  # of one colour
            box[:] = rng.uniform(-3.5, 0.0) + rng.normal(0.0, 0.3, 3)
            box += rng.normal(0.0, 0.1, box.shape)
        else:  # something seen elsewhere
            other = np.roll(log, (rng.integers(h), rng.integers(w)), (0, 1))
            box[:] = other[: box.shape[0], : box.shape[1]]
        covered = np.s_[
            y // pixels : -(-(y + tall) // pixels), x // pixels : -(-(x + wide) // pixels)
        ]
        patches[covered] = -1
    return patches


def mapped(things: Things, factors: Floats, rng: np.random.Generator) -> Things:
    """Objects as some map may hold them."""
    count = len(factors)
    light = things.light * factors[:, None]
    shading = rng.normal(0.0, rng.uniform(0.0, 0.4), (count, 1, 1))
    tint = rng.normal(0.0, rng.uniform(0.0, 0.08), (count, 1, 3))
    light *= np.exp(shading + tint).astype(np.float32)
    if rng.random() < 0.5:  # blurred, as a coarse map is
        mean = light.mean(axis=1, keepdims=True)
        light = mean + (light - mean) * np.float32(rng.uniform(0.3, 1.0))
    if rng.random() < 0.7:
        grey = light.mean(axis=2, keepdims=True)
        light = grey + (light - grey) * np.float32(rng.uniform(0.6, 1.3))
        level = float(np.exp(np.log(light.mean(axis=(1, 2)) + 1e-2).mean()))
        gain = np.exp(rng.normal(0.0, 0.12, 3)) * 0.3 * np.exp(rng.normal(0.0, 0.5)) / level
        light = 1.0 - np.exp(-np.maximum(light, 0.0) * gain.astype(np.float32))
        light **= np.float32(np.exp(rng.normal(0.0, 0.15)))
    light += rng.uniform(0.0, 0.05) * rng.standard_normal(light.shape, np.float32)
    form = things.form * (1.0 + rng.normal(0.0, 0.04, things.form.shape))
    form += rng.normal(0.0, 0.05, form.shape)
    return replace(
        things,
        form=form.astype(np.float32),
        light=np.clip(light, 0.0, 1.5).astype(np.float32),
        coloured=bool(rng.random() < 0.96),
    )


def labelled(words: Floats, rng: np.random.Generator) -> Floats:
    """Vectors of labels (N, d) of which some, or all, are lost."""
    if rng.random() < 0.5:
        return np.zeros_like(words)
    return words * (rng.random((len(words), 1)) < rng.uniform(0.6, 1.0)).astype(np.float32)


def _field(shape: tuple[int, int], strength: float, rng: np.random.Generator) -> Floats:
    """Factors (H, W) that change slowly over a picture: light that no lamp of ours gives."""
    knots = rng.normal(0.0, strength, (4, 5))
    for axis in (0, 1):
        cells = knots.shape[axis] - 1
        at = (np.arange(shape[axis]) + 0.5) / shape[axis] * cells
        low = at.astype(np.int64)
        part = np.expand_dims(at - low, 1 - axis)
        knots = np.take(knots, low, axis) * (1 - part) + np.take(knots, low + 1, axis) * part
    return np.exp(knots).astype(np.float32)


def _blurred(light: Floats) -> Floats:
    """Means over 3 x 3 pixels."""
    for axis in (0, 1):
        before, after = (np.roll(light, step, axis) for step in (1, -1))
        light = (light + before + after) / np.float32(3.0)
    return light
