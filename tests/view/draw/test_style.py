"""One table of looks: complete, consistent, and legible."""

import pytest
from PIL import ImageColor

from placegraph.view.draw.style import AREA, LINE, PAINTS, PALETTE, POINT, RULES, paint_of


def luminance(color):
    def linear(channel):
        c = channel / 255
        return c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4

    red, green, blue = (linear(c) for c in ImageColor.getrgb(color)[:3])
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(a, b):
    dark, light = sorted((luminance(a), luminance(b)))
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize(
    ("labels", "kind", "paint"),
    [
        (["shop=bakery"], POINT, "shop"),
        (["shop=never_heard_of"], POINT, "shop"),
        (["amenity=cafe", "name=*"], POINT, "food"),
        (["highway=secondary", "bridge=yes"], LINE, "main-road"),
        (["highway=never_heard_of"], LINE, "street"),
        (["amenity=school", "building=school"], AREA, "building"),
        (["amenity=school"], AREA, "grounds"),
        (["amenity=place_of_worship", "building=church"], AREA, "landmark"),
        (["leisure=park"], AREA, "park"),
        (["boundary=administrative"], AREA, ""),
        ([], POINT, ""),
    ],
)
def test_paint_of(labels, kind, paint):
    assert paint_of(labels, kind) == paint


def test_rules_name_paints_of_their_kind():
    forms = {AREA: {"area"}, LINE: {"line"}, POINT: {"crown", "disc", "square", "cross"}}
    for kind, rules in RULES.items():
        for line in rules.splitlines():
            if line and not line.startswith(" "):
                assert PAINTS[line.split()[0]].form in forms[kind]


def test_paints_use_the_palette():
    for paint in PAINTS.values():
        assert {paint.fill, paint.ink, paint.edge or paint.fill} <= PALETTE.keys()
    for colors in PALETTE.values():
        assert all(ImageColor.getrgb(color) for color in colors)


@pytest.mark.parametrize("ground", ["paper", "land"])
@pytest.mark.parametrize("ink", ["ink", "soft-ink", "for", "against", "mode", "amber", "park-ink"])
@pytest.mark.parametrize("dark", [False, True])
def test_lettering_has_contrast(ink, ground, dark):
    assert contrast(PALETTE[ink][dark], PALETTE[ground][dark]) >= 4.5


@pytest.mark.parametrize("dark", [False, True])
def test_numbers_on_pins_have_contrast(dark):
    assert contrast(PALETTE["on-mode"][dark], PALETTE["mode"][dark]) >= 4.5
