"""Embree 4 from the ``embreex`` wheel, by its C interface: no compiled extension of our own.

The wheel's libraries are loaded by ctypes, the scene is set up from Python, and kernels call
``rtcIntersect16`` by its address (`trace_kernels.trace16`). Layouts and numbers are declared by hand, so
they hold for the versions named here alone, and a scene with known answers proves them first.
"""

from __future__ import annotations

import ctypes
import re
import weakref
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.threads import count_processors
from placegraph.errors import MissingExtraError, PlacegraphError
from placegraph.indoor.rays.trace_kernels import (
    DIRECTION,
    FAR,
    LANES,
    MASK,
    NEAR,
    NONE,
    ORIGIN,
    ROWS,
    TRIANGLE,
    Tracer,
    U,
    V,
)

WHEEL = "4.4."  # Versions of ``embreex`` that start so are known
LIBRARY = range(40400, 40500)  # What the library may say its version is

_INDEX_BUFFER, _VERTEX_BUFFER = 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_TRIANGLES = 0
_VERSION = 0
_ROBUST = 4  # Without it rays leak through large meshes
_COHERENT = 1 << 16

_p = ctypes.c_void_p
_FUNCTIONS: dict[str, tuple[Any, list[Any]]] = {
    "rtcNewDevice": (_p, [ctypes.c_char_p]),
    "rtcReleaseDevice": (None, [_p]),
    "rtcGetDeviceError": (ctypes.c_int, [_p]),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, [_p, ctypes.c_int]),
    "rtcNewScene": (_p, [_p]),
    "rtcSetSceneFlags": (None, [_p, ctypes.c_int]),
    "rtcReleaseScene": (None, [_p]),
    "rtcCommitScene": (None, [_p]),
    "rtcNewGeometry": (_p, [_p, ctypes.c_int]),
    "rtcCommitGeometry": (None, [_p]),
    "rtcAttachGeometry": (ctypes.c_uint, [_p, _p]),
    "rtcReleaseGeometry": (None, [_p]),
    "rtcSetSharedGeometryBuffer": (
        None,
        [_p, ctypes.c_int, ctypes.c_uint, ctypes.c_int, _p, *[ctypes.c_size_t] * 3],
    ),
    "rtcIntersect16": (None, [_p] * 4),
}


def make_embree_tracer(vertices: NDArray[np.float32], triangles: NDArray[np.int32]) -> Tracer:
    """Make Embree scene of triangles (T, 3), rows of vertices (V, 3) [m]; lives as long as the tracer.

    Raises MissingExtraError where `explain_unavailable` finds one.
    """
    if reason := explain_unavailable():
        raise MissingExtraError(
            f"{reason} Install `embreex>=4.4,<4.5`, or choose the backend `bvh`."
        )
    return _make_scene(_load_library(), vertices, triangles)


@cache
def explain_unavailable() -> str:
    """Explain in a sentence why Embree cannot serve in this process; empty: it can."""
    try:
        version = distribution("embreex").version
    except PackageNotFoundError:
        return "The wheel `embreex` is not installed."
    if not version.startswith(WHEEL):
        return f"`embreex` has version {version}, but only {WHEEL}x is supported."
    try:
        return _self_test(_load_library())
    except (OSError, LookupError, AttributeError, PlacegraphError) as error:
        return f"The libraries of `embreex` {version} do not load or start: {error}."


@cache
def _load_library() -> ctypes.CDLL:
    """Load Embree of the wheel; the TBB it came with is loaded first, so that it is found."""
    found: dict[str, Path] = {}
    for file in distribution("embreex").files or ():
        if match := re.match(r"(?:lib)?(tbb|embree4).*\.(?:so|dylib|dll)", file.name):
            found[match[1]] = file.locate()  # type: ignore[assignment]
    ctypes.CDLL(str(found["tbb"]))
    library = ctypes.CDLL(str(found["embree4"]))
    for name, (result, arguments) in _FUNCTIONS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def _make_scene(
    library: ctypes.CDLL, vertices: NDArray[np.float32], triangles: NDArray[np.int32]
) -> Tracer:
    # Embree reads 16 bytes at the last vertex
    corners = np.zeros((len(vertices) + 2, 3), np.float32)
    corners[: len(vertices)] = vertices
    indices = np.ascontiguousarray(triangles, np.uint32)
    arguments = np.zeros(16, np.int32)
    arguments[:2] = _COHERENT, -1  # flags, and every feature

    device = library.rtcNewDevice(f"threads={count_processors()}".encode())
    if not device:
        raise PlacegraphError(f"Embree gives error {library.rtcGetDeviceError(None)}")
    version = library.rtcGetDeviceProperty(device, _VERSION)
    if version not in LIBRARY:
        library.rtcReleaseDevice(device)
        raise PlacegraphError(f"Embree reports version {version}")
    scene = library.rtcNewScene(device)
    library.rtcSetSceneFlags(scene, _ROBUST)
    geometry = library.rtcNewGeometry(device, _TRIANGLES)
    for kind, layout, array, rows in (
        (_VERTEX_BUFFER, _FLOAT3, corners, len(vertices)),
        (_INDEX_BUFFER, _UINT3, indices, len(indices)),
    ):
        library.rtcSetSharedGeometryBuffer(
            geometry, kind, 0, layout, array.ctypes.data, 0, 12, rows
        )
    library.rtcCommitGeometry(geometry)
    library.rtcAttachGeometry(scene, geometry)
    library.rtcReleaseGeometry(geometry)
    library.rtcCommitScene(scene)
    if error := library.rtcGetDeviceError(device):
        _release(library, scene, device)
        raise PlacegraphError(f"Embree gives error {error}")
    address = ctypes.cast(library.rtcIntersect16, _p).value or 0
    # whoever holds the tracer holds this array, and with it the scene and its buffers
    token = np.zeros(1, np.float32)
    weakref.finalize(token, _release, library, scene, device, corners, indices, arguments)
    none = np.zeros(1, np.float32), np.zeros(1, np.int32)
    return Tracer(address, scene, arguments.ctypes.data, token, none[1], *none)


def _release(library: ctypes.CDLL, scene: int, device: int, *_buffers: NDArray[Any]) -> None:
    library.rtcReleaseScene(scene)
    library.rtcReleaseDevice(device)


def _self_test(library: ctypes.CDLL) -> str:
    """Trace one packet with known answers; if they differ, a sentence that says so.

    The packet lies amid room of its own size: a layout other than the one declared here should give
    wrong numbers, not a crash.
    """
    # shelves x, y >= 0, x + y <= 8 at heights 2 and 1, and one at height 3 that reaches farther
    shelf = np.array([[0, 0, 0], [8, 0, 0], [0, 8, 0]], np.float32)
    vertices = np.concatenate([shelf, shelf, 3 * shelf])
    vertices[:, 2] = np.repeat([2, 1, 3], 3)
    tracer = _make_scene(library, vertices, np.arange(9, dtype=np.int32).reshape(3, 3))

    size = (ROWS + 1) * LANES
    room = np.full(3 * size + LANES, 7.0, np.float32)
    start = size + (-(room.ctypes.data + 4 * size) % 64) // 4
    packet = room[start : start + ROWS * LANES].reshape(ROWS, LANES)
    ints = packet.view(np.int32)
    valid = room[start + ROWS * LANES : start + size].view(np.int32)
    lane = np.arange(LANES)
    packet[:] = 0.0
    packet[ORIGIN], packet[ORIGIN + 1] = 0.5 * lane + 0.5, 1.0
    packet[DIRECTION + 2], packet[FAR] = 0.5, np.inf
    ints[MASK], ints[TRIANGLE], valid[:] = -1, NONE, -1
    packet[ORIGIN + 1, 1] = -1.0  # beside everything
    packet[NEAR, 2] = 3.0  # begins above the lower shelf
    packet[FAR, 3] = 1.5  # ends below it
    valid[4] = 0
    expected = np.where(0.5 * lane + 1.5 <= 8.0, 1, 2)
    expected[:5] = 1, NONE, 0, NONE, NONE
    far = np.array([np.inf, 4.0, 2.0, 6.0])[expected + 1]  # in order of triangle + 1
    far[3] = 1.5
    library.rtcIntersect16(valid.ctypes.data, tracer.scene, packet.ctypes.data, tracer.arguments)

    hit, side = expected >= 0, np.where(expected == 2, 24.0, 8.0)
    right = (
        np.array_equal(ints[TRIANGLE], expected)
        and np.allclose(packet[FAR], far)
        and np.allclose(packet[U], np.where(hit, packet[ORIGIN] / side, 0.0), atol=1e-6)
        and np.allclose(packet[V], np.where(hit, packet[ORIGIN + 1] / side, 0.0), atol=1e-6)
        and (room[:start] == 7.0).all()
        and (room[start + size :] == 7.0).all()
    )
    return "" if right else "Embree returns wrong results for a test scene."
