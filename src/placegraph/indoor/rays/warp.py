"""Rays on a CUDA GPU, by NVIDIA Warp (extra ``gpu``): found and started without a word."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.rays.caster import Hits, checked_mesh, checked_rays

WarpArray: TypeAlias = Any
"""An array on a device of Warp, which is imported only where it is used."""

_QUIET = {"quiet": True, "log_level": 40, "use_precompiled_headers": False}
"""Settings of Warp, by name, while it starts or compiles; versions differ in which they have.

Precompiled headers would be left to Python's last moments to be removed, with a warning."""


def open_device(name: str) -> tuple[ModuleType, Any]:
    """Warp, and its device ``cpu``, ``cuda`` (the first) or ``cuda:N``.

    Raises MissingExtraError where Warp is not installed, OptionError where there is no such device.
    """
    kind, _, number = name.partition(":")
    if kind not in {"cpu", "cuda"} or (number and not (kind == "cuda" and number.isdecimal())):
        raise OptionError(f"device is {name!r}; it is 'cpu', 'cuda' or 'cuda:N'.")
    if kind == "cuda" and not _has_driver():
        raise OptionError(
            f"device is {name!r}, but this machine has no CUDA driver; choose 'cpu' or 'auto'."
        )
    try:
        import warp
    except ImportError as error:
        raise MissingExtraError(
            f"The device {name!r} is driven by NVIDIA Warp, which is not installed; "
            "install `placegraph[gpu]`."
        ) from error
    with quietly(warp):
        warp.init()
        if kind == "cuda":
            devices = warp.get_cuda_devices()
            if int(number or 0) >= len(devices):
                raise OptionError(
                    f"device is {name!r}, but there are {len(devices)} CUDA devices; "
                    "choose another, 'cpu' or 'auto'."
                )
            return warp, devices[int(number or 0)]
        return warp, warp.get_device("cpu")


@contextmanager
def quietly(warp: ModuleType) -> Iterator[None]:
    """No banner and no notes on compilation inside; what the caller had set holds again after."""
    saved = {name: getattr(warp.config, name) for name in _QUIET if hasattr(warp.config, name)}
    for name in saved:
        setattr(warp.config, name, _QUIET[name])
    try:
        yield
    finally:
        for name, value in saved.items():
            setattr(warp.config, name, value)


def _has_driver() -> bool:
    """Asked before Warp is, since Warp complains of a missing driver on the error channel."""
    try:
        ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return False
    return True


class WarpCaster:
    """Closest hits with a triangle mesh, as `RayCaster` gives them.

    Parameters
    ----------
    vertices
        (V, 3) [m], finite; kept as float32.
    triangles
        (T, 3) rows of vertices.
    device
        ``cuda`` (the first), ``cuda:N``, or ``cpu``: one thread, meant for tests.

    Raises
    ------
    OptionError
        The mesh is not one (see `RayCaster`), or there is no such device.
    MissingExtraError
        Warp is not installed.
    """

    def __init__(self, vertices: ArrayLike, triangles: ArrayLike, *, device: str = "cuda") -> None:
        corners, rows = checked_mesh(vertices, triangles)
        self.warp, self.device = open_device(device)
        from placegraph.indoor.rays import warp_kernels

        self._kernels = warp_kernels
        wp = self.warp
        with quietly(wp):
            wp.load_module(warp_kernels, device=self.device)
            # by the surface area heuristic: the quicker build that is Warp's choice on a GPU
            # makes trees whose rays take longer
            self.mesh = wp.Mesh(
                points=self.vectors(corners),
                indices=self.array(rows.ravel()),
                bvh_constructor="sah",
            )

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Closest hits of rays from `origins` (N, 3) or (3,) [m] along `directions` (N, 3)."""
        start, along = checked_rays(origins, directions)
        with np.errstate(invalid="ignore", over="ignore"):
            lengths = np.linalg.norm(along.astype(np.float64), axis=1)
            sane = np.isfinite(start).all(axis=1) & np.isfinite(lengths) & (lengths > 0.0)
        unit = np.where(sane[:, None], along / np.where(sane, lengths, 1.0)[:, None], 0.0)
        start = np.where(sane[:, None], start, 0.0)
        hits = Hits.empty(len(along))
        columns = [self.array(column) for column in _columns(hits)]
        self.warp.launch(
            self._kernels.cast,
            len(along),
            [self.mesh.id, self.vectors(start), self.vectors(unit), *columns],
            device=self.device,
        )
        for column, result in zip(_columns(hits), columns, strict=True):
            column[:] = result.numpy()
        hits.distance[:] = hits.distance / np.where(sane, lengths, 1.0)
        return hits

    def array(self, values: NDArray[Any]) -> WarpArray:
        """A numpy array on the device."""
        kind = self.warp.dtype_from_numpy(values.dtype)
        return self.warp.array(values, dtype=kind, device=self.device)

    def vectors(self, values: NDArray[Any]) -> WarpArray:
        """Rows of (N, 3) as vectors on the device."""
        rows = np.ascontiguousarray(values, np.float32)
        return self.warp.array(rows, dtype=self.warp.vec3, device=self.device)


def _columns(hits: Hits) -> tuple[Any, ...]:
    return hits.triangle, hits.distance, hits.u, hits.v
