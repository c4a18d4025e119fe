"""Materials of glTF as pictures: base colour, texture, and how texture coordinates are read."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.io.mesh.gltf import Gltf
from placegraph.io.mesh.gltf_file import Json
from placegraph.io.mesh.model import Picture

_CLAMP, _MIRROR = 33071, 33648
_EDGE = 1e-4  # of a texture: within the outermost texel of any texture a map holds
_SRGB_WRITERS = ("trimesh", "open3d")
"""Generators that write COLOR_0 as sRGB, where the standard says linear."""


@dataclass(frozen=True, slots=True)
class Look:
    """How a primitive is coloured."""

    picture: int
    """Row of the picture."""
    texcoord: int = 0
    """Which TEXCOORD."""
    affine: NDArray[np.float64] | None = None
    """(2, 3) to be applied to texture coordinates."""
    clamped: tuple[bool, bool] = (False, False)
    mirrored: tuple[bool, bool] = (False, False)

    def place(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """Texture coordinates (V, 2) for a picture that is plainly repeated.

        Coordinates beyond a clamped edge are clamped at the vertices, so inside a triangle that
        reaches beyond it the texture is stretched a little.
        """
        if self.affine is not None:
            uv = uv @ self.affine[:, :2].T + self.affine[:, 2]
        for axis in (0, 1):
            if self.clamped[axis]:
                uv[:, axis] = np.clip(uv[:, axis], _EDGE, 1.0 - _EDGE)
            if self.mirrored[axis]:
                uv[:, axis] /= 2.0
        return uv


class Materials:
    """Pictures of a file's materials, each made once."""

    def __init__(self, gltf: Gltf) -> None:
        self.gltf = gltf
        self._looks: dict[int | None, Look] = {}
        self._pictures: dict[Picture, int] = {}
        self._images: dict[int, bytes] = {}

    def pictures(self) -> tuple[Picture, ...]:
        """All pictures that were asked for, one at least."""
        return tuple(self._pictures) or (Picture(None),)

    def look(self, row: Any) -> Look:  # noqa: ANN401  # whatever the file says
        """Look of `materials[row]`; plain white where `row` is None."""
        if row is None:
            return Look(self._picture(Picture(None)))
        material = self.gltf.item("materials", row)
        if row not in self._looks:
            self._looks[row] = self._make(material)
        return self._looks[row]

    def _picture(self, picture: Picture) -> int:
        return self._pictures.setdefault(picture, len(self._pictures))

    def _make(self, material: Json) -> Look:
        gltf = self.gltf
        base = gltf.object_of(material, "pbrMetallicRoughness")
        keys = ("baseColorTexture", "baseColorFactor")
        older = gltf.object_of(material, "extensions").get("KHR_materials_pbrSpecularGlossiness")
        if isinstance(older, dict) and keys[0] not in base:
            base, keys = older, ("diffuseTexture", "diffuseFactor")
        r, g, b, _ = np.clip(gltf.floats(base, keys[1], (1.0,) * 4), 0.0, 1.0).tolist()
        info = gltf.object_of(base, keys[0])
        if not info:
            return Look(self._picture(Picture(None, (r, g, b))))
        texture = gltf.item("textures", info.get("index"))
        wraps = [0, 0]
        if "sampler" in texture:
            sampler = gltf.item("samplers", texture["sampler"])
            wraps = [gltf.whole(sampler, key) for key in ("wrapS", "wrapT")]
        mirrored = (wraps[0] == _MIRROR, wraps[1] == _MIRROR)
        data, name = self._image(texture)
        moved = gltf.object_of(gltf.object_of(info, "extensions"), "KHR_texture_transform")
        texcoord = moved if "texCoord" in moved else info
        return Look(
            picture=self._picture(Picture(data, (r, g, b), mirrored, name)),
            texcoord=gltf.whole(texcoord, "texCoord"),
            affine=self._affine(moved) if moved else None,
            clamped=(wraps[0] == _CLAMP, wraps[1] == _CLAMP),
            mirrored=mirrored,
        )

    def _image(self, texture: Json) -> tuple[bytes, str]:
        source = texture.get("source")
        webp = self.gltf.object_of(texture, "extensions").get("EXT_texture_webp")
        if isinstance(webp, dict):
            source = webp.get("source", source)
        entry = self.gltf.item("images", source)
        row = self.gltf.whole({"source": source}, "source")
        if row not in self._images:
            self._images[row] = self.gltf.image(row)
        return self._images[row], f"{self.gltf.path}: images[{row}] {entry.get('name', '')}".strip()

    def _affine(self, moved: Json) -> NDArray[np.float64]:
        """KHR_texture_transform: scale, then rotation (counter-clockwise of v down), then offset."""
        scale, offset = (
            self.gltf.floats(moved, key, default)
            for key, default in (("scale", (1.0, 1.0)), ("offset", (0.0, 0.0)))
        )
        (turn,) = self.gltf.floats({"rotation": [moved.get("rotation", 0.0)]}, "rotation", (0.0,))
        c, s = cos(turn), sin(turn)
        return np.column_stack([np.array([[c, s], [-s, c]]) * scale, offset])


def vertex_colours(gltf: Gltf, values: NDArray[Any]) -> NDArray[np.uint8]:
    """Vertex colours (V, 3) uint8, sRGB, of COLOR_0, which is linear by the standard."""
    if values.shape[1] < 3:
        raise gltf.error("a COLOR_0 has not three channels; export it again")
    share = values[:, :3].astype(np.float64)
    if values.dtype.kind == "u":  # integers that forgot to say that they are normalised
        share /= np.iinfo(values.dtype).max
    share = np.clip(np.nan_to_num(share), 0.0, 1.0)
    generator = str(gltf.object_of(gltf.content, "asset").get("generator", "")).lower()
    if not any(writer in generator for writer in _SRGB_WRITERS):
        share = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * share).astype(np.uint8)
