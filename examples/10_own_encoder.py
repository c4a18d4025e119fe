"""An encoder of one's own: patches and objects become vectors; here, of their mean colour."""

import sys
from pathlib import Path

import numpy as np

import placegraph as pg


def embed_colours(colours):
    """Unit vectors (..., 4) of colours (..., 3)."""
    tint = colours / (colours.mean(axis=-1, keepdims=True) + 1.0) - 1.0
    tint = np.concatenate([tint, np.full((*tint.shape[:-1], 1), 0.1)], axis=-1)
    return (tint / np.linalg.norm(tint, axis=-1, keepdims=True)).astype(np.float32)


class Tints:
    name, key, dimension, temperature = "tints", "tints 1", 4, 0.05

    def patches(self, image):  # (rows, columns, d)
        rgb = image.rgb()[:180, :320].reshape(9, 20, 16, 20, 3)
        return embed_colours(rgb.mean(axis=(1, 3)))

    def camera(self, image):  # whose image the grid divides
        return image.camera

    def objects(self, scene, captures=()):  # (n, d): the colour of each object's surface
        mesh = scene.mesh
        texels = np.array([texture.mean(axis=(0, 1)) for texture in mesh.textures])
        colour = texels[mesh.texture_of] * mesh.colours[mesh.triangles].mean(axis=1)
        sums = [np.bincount(mesh.object_of, c, len(scene)) for c in colour.T]
        return embed_colours(np.stack(sums, axis=1) / np.bincount(mesh.object_of)[:, None])


world = Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out/world")  # left by `placegraph demo`
scene = pg.open_map(world / "altbau.scene")  # made by 04_build_from_glb.py
walk = pg.open_capture(world / "walk")
pose = scene.localize(walk[:8], encoder=Tints(), refine=False, seed=0)
print(f"{pose.status}: {pose.reason}")
