"""Vectors of objects as map files hold them: whole numbers of 8 bits, and a scale each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def in_8_bits(vectors: NDArray[np.float32]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """Whole numbers (N, E) from -127 to 127 and scales (N,) whose product is near vectors (N, E).

    Off by at most 1/250 of a vector's largest entry; doing it again changes nothing.
    """
    most = np.abs(vectors).max(axis=1, initial=0.0).astype(np.float64)
    mantissa, exponent = np.frexp(most / 127.0)
    # few bits, so that products are exact
    scales = np.ldexp(np.ceil(mantissa * 4096.0) / 4096.0, exponent).astype(np.float32)
    divisor = np.where(scales > 0, scales, np.float32(1.0))
    return np.rint(vectors / divisor[:, None]).astype(np.int8), scales


def from_8_bits(numbers: NDArray[np.int8], scales: NDArray[np.float32]) -> NDArray[np.float32]:
    """Vectors (N, E) of `in_8_bits`."""
    return numbers.astype(np.float32) * scales[:, None]
