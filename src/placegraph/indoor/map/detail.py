"""How much of a source a scene map keeps: error of its surface, size of its texels, steps."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import GRAIN, UV_GRAIN

_LARGEST = 1 << 14  # texels a side


@dataclass(frozen=True, slots=True)
class Detail:
    """What is kept; the defaults lose nothing that localization would miss (docs/benchmarks/maps.md)."""

    error: float | None = 0.005
    """Greatest distance of the simplified surface's vertices from the source's [m]; None: the
    source's triangles as they are."""
    texel: float = 0.003
    """Least length of a texel on the surface [m]: finer textures are made smaller; 0: as they are."""
    baked: float = 0.01
    """Length of a texel of textures made from colours of vertices or from a capture's images [m]."""
    max_texture: int = 512
    """Longer sides of the source's textures are brought to this many texels."""
    quality: int = 80
    """Of WebP, 1 to 100; 0: a source's JPEG and PNG are kept where that is possible."""
    grain: float = 8 * GRAIN
    """Step of vertices [m], a power of two: 0.98 mm."""
    uv_grain: float = 4 * UV_GRAIN
    """Step of texture coordinates, a power of two."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and not (np.isfinite(value) and value >= 0):
                raise OptionError(f"{field.name} is {value}; it must be 0 or more.")
        if not 1 <= self.max_texture <= _LARGEST:
            raise OptionError(
                f"max_texture is {self.max_texture}; it must be 1 to {_LARGEST} texels."
            )
        if self.quality > 100:
            raise OptionError(f"quality is {self.quality}; WebP's quality is 1 to 100, or 0.")
        if not 1e-3 <= self.baked <= 1.0:
            raise OptionError(f"baked is {self.baked} m; texels are 0.001 to 1 m.")
        for name, least in (("grain", GRAIN), ("uv_grain", UV_GRAIN)):
            if getattr(self, name) < least or np.log2(getattr(self, name)) % 1.0:
                raise OptionError(
                    f"{name} is {getattr(self, name)}; it must be a power of two from {least} on."
                )


FULL = Detail(error=None, texel=0.0, quality=0, grain=GRAIN, uv_grain=UV_GRAIN)
DETAILS = {
    "full": FULL,
    "fine": Detail(error=0.002, texel=0.002),
    "default": Detail(),
    "small": Detail(error=0.01, texel=0.01, baked=0.02, quality=70),
    "tiny": Detail(error=0.03, texel=0.04, baked=0.05, quality=60),
}
"""By name, as `--detail` takes them."""


def detail_named(detail: str | Detail) -> Detail:
    """Detail of a name; `OptionError` where there is none of this name."""
    if isinstance(detail, Detail):
        return detail
    if detail not in DETAILS:
        raise OptionError(f"detail is {detail!r}; it is one of {', '.join(DETAILS)}.")
    return DETAILS[detail]
