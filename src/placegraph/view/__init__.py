"""Pictures and pages of a map and of an estimate on it."""

from placegraph.view.city_page import write_page
from placegraph.view.city_picture import draw_city, write_picture

__all__ = ["draw_city", "write_page", "write_picture"]
