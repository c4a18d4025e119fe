"""Training of SceneGraphLoc."""
