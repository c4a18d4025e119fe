"""NVIDIA Warp, found, started without a word, and its devices by name."""

from __future__ import annotations

import ctypes
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from placegraph.errors import MissingExtraError, OptionError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from types import ModuleType

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
