"""The plan of a scene as a page draws it."""

from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image, ImageColor
from tests.view.scene.test_scene_plan import BOXES, near, scene_of

from placegraph.core.geo import Anchor
from placegraph.errors import OptionError
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.page import FINE, MOST, picture, plan_of, told
from placegraph.view.scene.room_plan import ROOM_PAINTS


@pytest.fixture(scope="module")
def plan():
    scene = scene_of(BOXES, scene="room").anchored(Anchor(9.99, 53.55, 0.0, 0.3, building="Hall"))
    rooms = [{"room": "</script>"} if label == "floor" else {} for label in scene.graph.labels]
    return plan_of(replace(scene, attributes=tuple(rooms)))


def test_things_are_told_as_they_stand(plan):
    page = told(plan)
    things = {thing["label"]: thing for thing in page["things"]}
    assert (things["floor"]["name"], things["floor"]["room"]) == ("</script>", True)
    assert (things["KitchenTable"]["name"], things["KitchenTable"]["room"]) == (
        "kitchen table",
        False,
    )
    assert things["KitchenTable"]["box"] == [5, 3, 7, 4]
    assert (things["wall"]["role"], things["wall"]["name"]) == ("structure", "")
    assert "ceiling" not in things
    assert things["lamp"]["name"] == ""  # it hangs above the table
    assert page["anchors"][0]["building"] == "Hall"


@pytest.mark.parametrize("dark", [False, True])
def test_the_picture_is_of_the_bounds_alone(plan, dark):
    west, south, east, north = told(plan)["bounds"]
    with Image.open(BytesIO(picture(plan, dark=dark))) as image:
        pixels = np.asarray(image)
    assert pixels.shape[1] == pytest.approx(FINE * (east - west), abs=1)
    assert pixels.shape[0] == pytest.approx(FINE * (north - south), abs=1)
    table = ROOM_PAINTS["table"].dark if dark else ROOM_PAINTS["table"].light
    x, y = FINE * (6.0 - west), FINE * (north - 3.5)
    assert near(tuple(pixels[int(y), int(x)].tolist()), ImageColor.getrgb(table))
    assert near(tuple(pixels[0, 0].tolist()), ImageColor.getrgb(PALETTE["land"][dark]))


def test_a_large_scene_has_a_picture_of_bounded_size():
    wide = scene_of({"floor": ((0, 0, -0.1), (400, 5, 0))}, scene="hall")
    with Image.open(BytesIO(picture(plan_of(wide)))) as image:
        assert image.width <= MOST + 1
        assert image.height >= 1


def test_a_scene_that_is_not_there_is_told():
    with pytest.raises(OptionError, match="no 'attic'; it has room"):
        plan_of(scene_of(BOXES, scene="room"), "attic")
