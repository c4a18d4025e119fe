"""From the authors' files to a pose, at the published sizes; the numbers are drawn by chance."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

import placegraph as pg
from placegraph.indoor.encode import encoder

WIDTH, BLOCKS, HIDDEN, CELLS = 1536, 40, 4096, 37
"""Of DINOv2 ViT-g/14: SwiGLU, 518 px."""
NEEDED = 7e9
"""Bytes of disk, and of memory, that make a file of 4.5 GB."""


def _dino(torch):
    """State dict spelled as dinov2_vitg14_pretrain.pth is."""
    drawn = torch.Generator().manual_seed(0)

    def some(*shape, around=0.0):
        return torch.randn(shape, generator=drawn) * 0.02 + around

    state = {
        "cls_token": some(1, 1, WIDTH),
        "pos_embed": some(1, 1 + CELLS * CELLS, WIDTH),
        "mask_token": some(1, WIDTH),
        "patch_embed.proj.weight": some(WIDTH, 3, 14, 14),
        "patch_embed.proj.bias": some(WIDTH),
        "norm.weight": some(WIDTH, around=1.0),
        "norm.bias": some(WIDTH),
    }
    for i in range(BLOCKS):
        block = f"blocks.{i}."
        for norm in ("norm1", "norm2"):
            state[f"{block}{norm}.weight"] = some(WIDTH, around=1.0)
            state[f"{block}{norm}.bias"] = some(WIDTH)
        for scale in ("ls1", "ls2"):
            state[f"{block}{scale}.gamma"] = some(WIDTH, around=0.1)
        for name, rows, columns in (
            ("attn.qkv", 3 * WIDTH, WIDTH), ("attn.proj", WIDTH, WIDTH),
            ("mlp.w12", 2 * HIDDEN, WIDTH), ("mlp.w3", WIDTH, HIDDEN),
        ):  # fmt: skip
            state[f"{block}{name}.weight"] = some(rows, columns)
            state[f"{block}{name}.bias"] = some(rows)
    return state


@pytest.fixture
def files(timm, shared, tmp_path):  # noqa: ARG001
    """Snapshot of SceneGraphLoc and weights of DINOv2, as their authors write them."""
    import torch

    free = min(shutil.disk_usage(tmp_path).free, _available())
    if free < NEEDED:
        pytest.skip(f"needs {NEEDED / 1e9:.0f} GB of disk and memory, and has {free / 1e9:.1f}")
    known = load_file(shared / "conformance/scenegraphloc/state_dict.safetensors")
    snapshot, dino = tmp_path / "snapshot.pth.tar", tmp_path / "dinov2_vitg14_pretrain.pth"
    torch.save({"epoch": 60, "iteration": 1, "model": known}, snapshot)
    torch.save(_dino(torch), dino)
    yield snapshot, dino
    dino.unlink()


def _available():
    lines = Path("/proc/meminfo").read_text("ascii").splitlines()
    told = dict(line.split(":") for line in lines)
    return 1024 * int(told["MemAvailable"].split()[0])


@pytest.mark.all
def test_from_the_authors_files_to_a_pose(files, room, walk, survey, truth, tmp_path):
    import torch

    snapshot, dino = files
    torch.set_num_threads(torch.get_num_interop_threads())
    made = encoder(f"scenegraphloc weights={snapshot} feature_weights={dino} rotate=False")
    assert (made.dimension, made.features.dimension) == (400, WIDTH)
    patches = made.patches(walk[0])
    assert patches.shape == (9, 16, 400)
    assert np.linalg.norm(patches, axis=2) == pytest.approx(1.0, abs=1e-5)
    assert np.ptp(patches.reshape(144, 400) @ patches[0, 0]) > 1e-3

    known = room.with_embeddings(made.objects(room, [survey[:1]]), encoder=made.key)
    known.save(tmp_path / "known.scene")
    opened = pg.open_map(tmp_path / "known.scene")
    found = opened.localize(walk, frames=slice(2), encoder=made, seed=0)
    off = found.best.map_from_camera[:3, 3] - truth(walk)[1, :3, 3]
    assert np.linalg.norm(off) < 0.5  # by its depth: the network knows nothing

    library = pg.SceneLibrary(made)
    library.add("room", tmp_path / "known.scene")
    assert library.search(walk[:1]).best.scene == "room"
