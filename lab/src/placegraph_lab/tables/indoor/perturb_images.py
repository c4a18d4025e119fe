"""What goes wrong with images, and input that no answer may be sure of; see `perturb`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from placegraph.errors import OptionError
from placegraph.io.capture.frame import ArrayImages, Frame
from placegraph_lab.tables.indoor.perturb import Recording, Shot, seen


def dark(shot: Shot, percent: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Images of so much of the light."""
    return shot.each(lambda f: seen(f, rgb=(f.rgb() * (percent / 100.0)).astype(np.uint8)))


def noise(shot: Shot, deviation: float, rng: Generator) -> Shot:
    """Noise of so many of 255 steps in each pixel and channel."""

    def change(frame: Frame) -> Frame:
        rgb = frame.rgb()
        noisy = rgb + deviation * rng.normal(size=rgb.shape)
        return seen(frame, rgb=np.clip(noisy, 0, 255).astype(np.uint8))

    return shot.each(change)


def blur(shot: Shot, pixels: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Images blurred by a Gaussian of so many pixels."""
    from PIL import Image, ImageFilter

    def change(frame: Frame) -> Frame:
        image = Image.fromarray(frame.rgb()).filter(ImageFilter.GaussianBlur(pixels))
        return seen(frame, rgb=np.asarray(image))

    return shot.each(change)


# ----------------------------------------------------------------------------------- bad input


def lens_cap(shot: Shot, _: float, rng: Generator) -> Shot:
    """Black images with a sensor's noise, and no reading of depth."""

    def change(frame: Frame) -> Frame:
        black = np.clip(3.0 + 2.0 * rng.normal(size=frame.rgb().shape), 0, 255)
        depth = frame.depth()
        blind = None if depth is None else np.full_like(depth, np.nan)
        return seen(frame, rgb=black.astype(np.uint8), depth=blind)

    return shot.each(change)


def frozen(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """All images are the first, while odometry goes on."""
    first = seen(shot.frames[0])
    return shot.each(lambda f: seen(f, rgb=first.rgb(), depth=first.depth()))


def mirrored(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Left and right changed in images and depth."""

    def change(frame: Frame) -> Frame:
        depth = frame.depth()
        flipped = None if depth is None else np.ascontiguousarray(depth[:, ::-1])
        return seen(frame, rgb=np.ascontiguousarray(frame.rgb()[:, ::-1]), depth=flipped)

    return shot.each(change)


def gravity_up(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Gravity with the wrong sign, as of an accelerometer at rest."""
    return shot.each(lambda f: replace(f, gravity=-f.gravity))


def backwards(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Stamps fall from frame to frame."""
    stamps = [f.stamp for f in shot.frames][::-1]
    pairs = zip(shot.frames, stamps, strict=True)
    return replace(shot, frames=tuple(replace(f, stamp=stamp) for f, stamp in pairs))


def half_elsewhere(shot: Shot, other: Recording) -> Shot:
    """The first half of the images is of another recording."""
    frames = list(shot.frames)
    for i in range(len(frames) // 2):
        theirs = other.frames[i]
        frames[i] = seen(
            frames[i],
            rgb=theirs.rgb(),
            depth=theirs.depth(),
            camera=theirs.camera,
            depth_camera=theirs.depth_camera,
        )
    return replace(shot, frames=tuple(frames))


def only(shot: Shot, senses: tuple[str, ...]) -> Shot:
    """The shot with these of `labels`, `depth` and `colour`; who has none of them is refused."""
    if not senses:
        raise OptionError("senses: there is none; give labels, depth or colour.")
    labels, depth = "labels" in senses, "depth" in senses

    def change(frame: Frame) -> Frame:
        images = ArrayImages(
            frame.rgb(), frame.depth() if depth else None, frame.labels() if labels else None
        )
        return replace(
            frame,
            images=images,
            depth_camera=frame.depth_camera if depth else None,
            label_camera=frame.label_camera if labels else None,
            label_kind=frame.label_kind if labels else None,
        )

    return shot.each(change)
