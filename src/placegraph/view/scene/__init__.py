"""Plans of scenes, poses found, overlays, changes."""
