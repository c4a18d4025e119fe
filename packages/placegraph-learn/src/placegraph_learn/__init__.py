"""Networks that need PyTorch: SceneGraphLoc, backbones, RoMa, XFeat, and trainings."""
