"""Embree 4 from the ``embreex`` wheel, by its C interface: no compiled extension of our own.

The wheel's libraries are loaded by ctypes, the scene is set up from Python, and kernels call
``rtcIntersect16`` by its address (`packets.trace16`).
"""

from __future__ import annotations

import ctypes
import weakref
from importlib.metadata import files
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.indoor.raycast.packets import Tracer

if TYPE_CHECKING:
    from numpy.typing import NDArray

_INDEX_BUFFER, _VERTEX_BUFFER = 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_TRIANGLES = 0
_ROBUST = 4
"""Without it rays leak through large meshes."""
_COHERENT = 1 << 16

_p = ctypes.c_void_p


def _load() -> ctypes.CDLL:
    """Libraries of the wheel; Embree needs its TBB in the global namespace first."""
    found = {f.name.split("-")[0]: f.locate() for f in files("embreex") or () if ".so" in f.name}
    ctypes.CDLL(str(found["libtbb"]), mode=ctypes.RTLD_GLOBAL)
    library = ctypes.CDLL(str(found["libembree4"]))
    for name, result, arguments in (
        ("rtcNewDevice", _p, [ctypes.c_char_p]),
        ("rtcReleaseDevice", None, [_p]),
        ("rtcGetDeviceError", ctypes.c_int, [_p]),
        ("rtcNewScene", _p, [_p]),
        ("rtcSetSceneFlags", None, [_p, ctypes.c_int]),
        ("rtcReleaseScene", None, [_p]),
        ("rtcCommitScene", None, [_p]),
        ("rtcNewGeometry", _p, [_p, ctypes.c_int]),
        ("rtcCommitGeometry", None, [_p]),
        ("rtcAttachGeometry", ctypes.c_uint, [_p, _p]),
        ("rtcReleaseGeometry", None, [_p]),
        (
            "rtcSetSharedGeometryBuffer",
            None,
            [_p, ctypes.c_int, ctypes.c_uint, ctypes.c_int, _p]
            + [ctypes.c_size_t] * 3,
        ),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


class EmbreeScene:
    """A triangle mesh in Embree.

    `vertices`: (V, 3) float32 [m]; `triangles`: (T, 3) uint32 rows of vertices.
    """

    def __init__(self, vertices: NDArray[np.float32], triangles: NDArray[np.uint32]) -> None:
        library = _load()
        # Embree reads 16 bytes at the last vertex
        padded = np.zeros((len(vertices) + 2, 3), np.float32)
        padded[: len(vertices)] = vertices
        indices = np.ascontiguousarray(triangles, np.uint32)
        arguments = np.zeros(16, np.int32)
        arguments[0], arguments[1] = _COHERENT, -1
        self._keep: tuple[Any, ...] = (padded, indices, arguments)

        device = library.rtcNewDevice(b"threads=2")
        scene = library.rtcNewScene(device)
        library.rtcSetSceneFlags(scene, _ROBUST)
        geometry = library.rtcNewGeometry(device, _TRIANGLES)
        for kind, layout, array, rows in (
            (_VERTEX_BUFFER, _FLOAT3, padded, len(vertices)),
            (_INDEX_BUFFER, _UINT3, indices, len(indices)),
        ):
            library.rtcSetSharedGeometryBuffer(
                geometry, kind, 0, layout, array.ctypes.data, 0, 12, rows
            )
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(scene, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(scene)
        error = library.rtcGetDeviceError(device)
        if error:
            raise RuntimeError(f"Embree error {error}")
        address = ctypes.cast(library.rtcIntersect16, _p).value or 0
        self.tracer = Tracer(address, scene, arguments.ctypes.data)
        weakref.finalize(self, _release, library, scene, device, self._keep)


def _release(library: ctypes.CDLL, scene: int, device: int, _keep: object) -> None:
    library.rtcReleaseScene(scene)
    library.rtcReleaseDevice(device)
