"""2048 signs of 64 that are nearly orthogonal: the code words of Kerdock's code of length 64.

32 sets of 64 orthogonal vectors, and any two of different sets have a cosine of 1/8 or -1/8. No
larger set of so many vectors is less alike (Cameron and Seidel, Quadratic forms over GF(2), 1973).
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

DIMENSION = 64
_FIELD = 32
_MODULUS = 0b100101  # x^5 + x^2 + 1, which makes GF(32)


@cache
def codes() -> NDArray[np.float32]:
    """Unit vectors (2048, 64) float32; rows 64 i to 64 i + 63 are orthogonal.

    Sign of place (x, y), x in GF(32), y in GF(2), of code (a, b, c): the parity of
    Tr((ax)^3 + (ax)^5 + bx) + y Tr(ax) + cy.
    """
    table, trace = _products(), _traces()
    x = np.arange(_FIELD)
    ax = table[x[:, None], x]  # (a, x)
    square = table[ax, ax]
    cube = table[square, ax]
    form = trace[cube] ^ trace[table[cube, square]]
    quadratic = np.stack([form, form ^ trace[ax]], axis=-1)  # (a, x, y)
    bx, y = trace[table[x[:, None], x]], np.arange(2)
    linear = bx[:, None, :, None] ^ (y[:, None] & y)[None, :, None, :]  # (b, c, x, y)
    parity = quadratic[:, None, None] ^ linear
    out = ((1.0 - 2.0 * parity) / np.sqrt(DIMENSION)).reshape(-1, DIMENSION).astype(np.float32)
    out.flags.writeable = False
    return out


def _products() -> NDArray[np.int64]:
    """Products (32, 32) of elements of GF(32), numbers whose bits are coefficients."""
    a, b = np.mgrid[:_FIELD, :_FIELD]
    product = np.zeros_like(a)
    for bit in range(5):
        product ^= (a << bit) * (b >> bit & 1)
    for bit in range(9, 4, -1):
        product ^= (_MODULUS << (bit - 5)) * (product >> bit & 1)
    return product


def _traces() -> NDArray[np.int64]:
    """Trace (32,) in GF(2) of each element: x + x^2 + x^4 + x^8 + x^16."""
    table, x = _products(), np.arange(_FIELD)
    total = x.copy()
    for _ in range(4):
        x = table[x, x]
        total ^= x
    return total
