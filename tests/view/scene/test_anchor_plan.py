"""Maps drawn where they stand: north up, on their building, the others faintly."""

import numpy as np
import pytest
from PIL import Image, ImageColor
from tests.view.scene.test_scene_plan import BOXES, scene_of

from placegraph.core.geo import Anchor
from placegraph.errors import GeoPoseError
from placegraph.view import draw_anchors
from placegraph.view.draw.style import PALETTE
from placegraph.world.outlines import footprints

HERE = Anchor(9.99, 53.55, 0.0, np.pi / 2, np.eye(4) * 0.01, "Hall", "way/1", "2", 0.6, "building")


def size(path):
    with Image.open(path) as image:
        return image.size


def count(path, color, frame=slice(64, -46)):
    """Pixels of a colour of the palette."""
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"), int)[frame]
    wanted = np.array(ImageColor.getrgb(PALETTE[color][0]))
    return np.argwhere(np.abs(pixels - wanted).max(axis=2) < 12)


@pytest.fixture
def building(tmp_path):
    """A building 9 m by 6 m around the room, with an entrance in the middle of its east side."""
    corners = np.array([(-0.5, -0.5), (8.5, -0.5), (8.5, 5.5), (-0.5, 5.5), (4.0, 5.5)])
    places = HERE.to_earth(np.column_stack([corners, np.zeros(5)]))
    nodes = "".join(
        f'<node id="{k}" lon="{lon:.9f}" lat="{lat:.9f}">'
        + ('<tag k="entrance" v="yes"/>' if k == 4 else "")
        + "</node>"
        for k, (lon, lat, _) in enumerate(places)
    )
    refs = "".join(f'<nd ref="{k % 4}"/>' for k in range(5))
    said = '<tag k="building" v="yes"/><tag k="name" v="Hall"/>'
    file = tmp_path / "a.osm"
    file.write_text(f'<osm version="0.6">{nodes}<way id="1">{refs}{said}</way></osm>')
    return footprints(file, "Hall")


def test_a_map_stands_on_its_building_north_up(building, tmp_path):
    turned = Anchor(9.99005, 53.55, 0.0, 0.4, probability=0.4)
    scene = scene_of(BOXES).anchored(HERE, turned)
    bare = draw_anchors(scene.anchored(HERE), tmp_path / "bare.png")
    alone = draw_anchors(scene.anchored(HERE), tmp_path / "alone.png", building)
    both = draw_anchors(scene, tmp_path / "both.png", building)
    width, height = size(bare)
    assert height - 64 - 46 > width  # the map's x axis, 8 m long, points south
    assert len(count(alone, "ink")) > len(count(bare, "ink")) + 1000
    (y, x) = count(alone, "for").mean(axis=0)
    ink = count(alone, "ink")
    middle = (ink.min(axis=0) + ink.max(axis=0)) / 2
    assert x > middle[1] + 400  # the entrance is in the east
    assert abs(y - middle[0]) < 60
    assert len(count(both, "mode")) > 50  # numbered, now that there are two
    assert len(count(alone, "mode")) == 0
    assert len(count(both, "soft-ink")) > len(count(alone, "soft-ink")) + 100


def test_far_candidates_are_told_and_not_drawn(tmp_path):
    far = Anchor(9.9, 53.55, 0.0, 0.4, probability=0.4)
    scene = scene_of(BOXES).anchored(HERE, far)
    drawn = draw_anchors(scene, tmp_path / "a.png")
    alone = draw_anchors(scene.anchored(HERE), tmp_path / "b.png")
    assert size(drawn) == size(alone)
    assert len(count(drawn, "mode")) == 0


def test_a_map_that_stands_nowhere_is_refused(tmp_path):
    with pytest.raises(GeoPoseError, match="scene anchor"):
        draw_anchors(scene_of(BOXES), tmp_path / "a.png")
