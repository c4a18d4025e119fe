"""The map as a camera would see it."""

from placegraph.indoor.render.renderer import Renderer, Rendering, camera_rays, checked_pose, render

__all__ = ["Renderer", "Rendering", "camera_rays", "checked_pose", "render"]
