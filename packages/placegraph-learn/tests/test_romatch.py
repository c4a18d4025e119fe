"""RoMa's own library behind our adapter, installed for the test alone."""

import os
import subprocess
import sys

import pytest

pytest.importorskip("torch", reason="needs PyTorch: pip install 'placegraph[roma]'")
pytest.importorskip("kornia", reason="needs kornia: pip install 'placegraph[roma]'")

PACKAGES = "romatch==0.1.2", "loguru", "einops"
"""What its networks import and we do not: pip would bring another PyTorch, and much besides."""
DRAWN = """
import sys
from pathlib import Path
from unittest.mock import patch
import numpy as np, torch
try:
    import torchvision
except RuntimeError:  # another PyTorch's: it declares no operators, and none is used
    library = torch.library.Library("torchvision", "DEF")
    for name in ("nms", "qnms"):
        library.define(name + "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
from kornia.feature import XFeat
from romatch.models.model_zoo import roma_indoor
from romatch.models.tiny import TinyRoMa
from placegraph.indoor.refine.matching import matcher

torch.manual_seed(0)
folder = Path(sys.argv[1])
with patch.object(torch.nn.Module, "load_state_dict", lambda *_: None):
    drawn = roma_indoor("cpu", weights={}, dinov2_weights={}, use_custom_corr=False)
torch.save(drawn.state_dict(), folder / "indoor.pth")
torch.save(drawn.encoder.dinov2_vitl14[0].state_dict(), folder / "dino.pth")
torch.save(TinyRoMa(xfeat=XFeat().net, freeze_xfeat=False).state_dict(), folder / "tiny.pth")
del drawn
query, view = np.random.default_rng(0).integers(0, 256, (2, 120, 160, 3), dtype=np.uint8)
for kind, more in (("indoor", {"backbone": folder / "dino.pth", "fine": 160}), ("tiny", {})):
    made = matcher(
        "roma", kind=kind, weights=folder / f"{kind}.pth", size=112, least=0.0, device="cpu", **more
    )
    (found,) = made.match(query, [view[:100]])
    assert len(found) > 100, len(found)
    assert found.query.shape == found.rendered.shape
    assert (found.query >= 0).all() and (found.query <= (160, 120)).all()
    assert (found.rendered >= 0).all() and (found.rendered <= (160, 100)).all()
"""


@pytest.mark.all
def test_the_library_itself_on_numbers_drawn_by_chance(tmp_path):
    """RoMa as published (`romatch`), ViT-L/14 and all, and the tiny one: 1.7 GB of weights."""
    site = tmp_path / "site"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--target",
        site,
        *PACKAGES,
    ]
    installed = subprocess.run(pip, capture_output=True, text=True, check=False)  # noqa: S603
    if installed.returncode:
        pytest.skip(f"romatch cannot be installed here: {installed.stderr[-200:]}")
    path = os.pathsep.join([str(site), *filter(None, sys.path)])
    asked = subprocess.run(  # noqa: S603
        [sys.executable, "-c", DRAWN, tmp_path],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    for file in tmp_path.glob("*.pth"):
        file.unlink()
    assert not asked.returncode, asked.stderr
