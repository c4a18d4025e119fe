"""Pictures and pages of a map and of an estimate on it."""

from placegraph.view.city_page import write_page
from placegraph.view.city_picture import draw_city, write_picture
from placegraph.view.overlay import write_overlay
from placegraph.view.scene_plan import draw_scene, write_plan, write_plan_animation

__all__ = [
    "draw_city",
    "draw_scene",
    "write_overlay",
    "write_page",
    "write_picture",
    "write_plan",
    "write_plan_animation",
]
