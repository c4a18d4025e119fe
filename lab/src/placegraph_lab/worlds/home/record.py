"""Captures of walks through homes, in memory; their images are rendered when they are asked for."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame, LabelKind
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.render import Stage
from placegraph_lab.worlds.flat.sensors import develop, measured
from placegraph_lab.worlds.flat.walks import Walk, drifted, exposures, gravity

CAMERA = Camera(160, 120, 115.0, 115.0, 80.0, 60.0)
"""70 degrees wide."""


def record(
    interior: Interior,
    walk: Walk,
    rng: np.random.Generator,
    *,
    camera: Camera = CAMERA,
    daylight: float = 0.5,
    depth: bool = False,
    labels: LabelKind | None = "labels",
    words: Mapping[str, str] | None = None,
) -> Capture:
    """Capture of a walk, with the light, exposure, noise and drift of `write_walk`, in memory.

    Images are rendered when a frame is first asked for them; the answer does not depend on which
    were asked for before. Depth and labels have half the camera's size.

    Parameters
    ----------
    interior
        The home as it is now.
    walk
        Poses of the camera, of which the capture holds drifting odometry alone.
    rng
        Draws light, noise and drift.
    camera
        Of the colour images.
    daylight
        From 0, evening with lamps on, to 1, day with lamps off.
    depth
        Whether frames have depth.
    labels
        Label images hold labels, ids of things, or are none.
    words
        What the labels are called in the capture, where it is not as in the interior: people who
        label maps have other words than networks that label images.

    Raises
    ------
    OptionError
        `labels` is none of its values.

    """
    if labels not in {"labels", "instances", None}:
        raise OptionError(f"labels is {labels!r}; it is 'labels', 'instances' or None.")
    light, sensor, motion = rng.spawn(3)
    said = {t.label: (words or {}).get(t.label, t.label) for t in interior.things}
    names = sorted(set(said.values()))
    value = np.full(max(t.id for t in interior.things) + 2, -1, np.int32)  # the last is nothing
    for thing in interior.things:
        value[thing.id] = names.index(said[thing.label]) if labels == "labels" else thing.id
    half = camera.resized(camera.width // 2, camera.height // 2)
    shared = _Set(interior, light, daylight, camera, half, value if labels else None)
    odometry = drifted(walk.map_from_camera, motion)
    down = gravity(walk.map_from_camera, motion)
    factors = exposures(len(walk), sensor)
    frames = [
        Frame(
            index=i,
            stamp=float(walk.stamps[i]),
            odometry=odometry[i],
            gravity=down[i],
            camera=camera,
            depth_camera=half if depth else None,
            label_camera=half if labels else None,
            label_kind=labels,
            label_names=dict(enumerate(names)) if labels == "labels" else {},
            images=_Rendered(
                shared, walk.map_from_camera[i], float(factors[i]), noise, depth=depth
            ),
        )
        for i, noise in enumerate(sensor.spawn(len(walk)))
    ]
    return Capture.from_frames(frames)


class _Set:
    """What all frames of a capture share; the stage is lit when the first image is wanted."""

    def __init__(
        self,
        interior: Interior,
        light: np.random.Generator,
        daylight: float,
        camera: Camera,
        half: Camera,
        value: NDArray[np.int32] | None,
    ) -> None:
        self.camera, self.half, self.value = camera, half, value
        self._interior, self._light, self._daylight = interior, light, daylight

    @cached_property
    def stage(self) -> Stage:
        return Stage(self._interior, self._light, daylight=self._daylight)


class _Rendered:
    """Images of one frame."""

    def __init__(
        self,
        shared: _Set,
        map_from_camera: NDArray[np.float64],
        exposure: float,
        rng: np.random.Generator,
        *,
        depth: bool,
    ) -> None:
        self._shared, self._pose, self._exposure = shared, map_from_camera, exposure
        self._colour_noise, self._depth_noise = rng.spawn(2)
        self._has_depth = depth

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self._rgb

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return self._depth if self._has_depth else None

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        return self._labels

    @cached_property
    def _rgb(self) -> NDArray[np.uint8]:
        shared = self._shared
        radiance = shared.stage.radiance(shared.camera, self._pose)
        return develop(radiance, self._exposure, self._colour_noise)

    @cached_property
    def _depth(self) -> NDArray[np.float32]:
        shot = self._shared.stage.shot(self._shared.half, self._pose)
        millimetres = measured(shot, self._depth_noise)
        return np.where(millimetres > 0, millimetres / np.float32(1000.0), np.nan).astype("f4")

    @cached_property
    def _labels(self) -> NDArray[np.int32] | None:
        if self._shared.value is None:
            return None
        shot = self._shared.stage.shot(self._shared.half, self._pose)
        values: NDArray[np.int32] = self._shared.value[shot.ids]
        return values
