"""Pictures and pages of a map and of an estimate on it."""

from placegraph.view.city.page import write_page
from placegraph.view.city.picture import draw_city, write_picture
from placegraph.view.scene.change_plans import draw_anchors
from placegraph.view.scene.overlay import write_overlay
from placegraph.view.scene.plan import draw_scene, write_plan, write_plan_animation

__all__ = [
    "draw_anchors",
    "draw_city",
    "draw_scene",
    "write_overlay",
    "write_page",
    "write_picture",
    "write_plan",
    "write_plan_animation",
]
