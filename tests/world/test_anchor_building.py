"""Maps that find their own place on a named building: headings, ties, entrances, wrong buildings."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geo import Anchor
from placegraph.errors import OptionError
from placegraph.world.anchor_building import fit_building
from placegraph.world.anchor_points import UNKNOWN_HEIGHT
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.home import scene_of

L_SHAPE = """
[drawing]
###==#########
#            #
#            #
=            =
#            #
#     ########
#     #
#  1  #
###+###
[legend]
1 room: label=hall
"""
SQUARE = """
[drawing]
#############
#           #
#           #
#           #
#     1     #
#           #
#           #
#           #
#           #
######+######
[legend]
1 room: label=hall
"""
METRES = {L_SHAPE: "0.6", SQUARE: "0.6 0.8"}
# walls are drawn thicker than they are: footprints go 0.3 m around the floor
OUTLINES = {
    L_SHAPE: [(0.3, 0.3), (3.9, 0.3), (3.9, 2.1), (8.1, 2.1), (8.1, 5.1), (0.3, 5.1)],
    SQUARE: [(0.3, 0.5), (7.5, 0.5), (7.5, 7.5), (0.3, 7.5)],
}
TRUE = Anchor(9.99, 53.55, 0.0, 0.7)


@pytest.fixture(scope="module")
def scenes():
    found = {}
    for text in (L_SHAPE, SQUARE):
        flat = Flat.parse(f"[flat]\nname = hall\nmetres = {METRES[text]}\nheight = 2.6\n{text}")
        found[text] = scene_of(flat.furnish(np.random.default_rng(1)))
    return found


def extract(path, corners, entrances=(), tags=()):
    """File of one building whose corners are (n, 2) [m] in the map."""
    points = [*corners, *entrances]
    places = TRUE.to_earth(np.column_stack([points, np.zeros(len(points))]))
    nodes = ""
    for k, (lon, lat, _) in enumerate(places):
        tag = '<tag k="entrance" v="main"/>' if k >= len(corners) else ""
        nodes += f'<node id="{k + 1}" lon="{lon:.9f}" lat="{lat:.9f}">{tag}</node>'
    refs = "".join(f'<nd ref="{k % len(corners) + 1}"/>' for k in range(len(corners) + 1))
    known = {"building": "yes", "name": "Stadtbibliothek", **dict(tags)}
    tags = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in known.items())
    path.write_text(f'<osm version="0.6">{nodes}<way id="7">{refs}{tags}</way></osm>')
    return path


def off(anchor, points):
    """Largest distance [m] of the corners from where they are."""
    points = np.column_stack([points, np.zeros(len(points))])
    return np.linalg.norm(TRUE.to_map(anchor.to_earth(points))[:, :2] - points[:, :2], axis=1).max()


def test_an_l_shape_finds_its_place(scenes, tmp_path):
    file = extract(tmp_path / "a.osm", OUTLINES[L_SHAPE], tags={"building:levels": "1"}.items())
    anchors, notes, shown = fit_building(scenes[L_SHAPE], file, "stadtbibliothek")
    best = anchors[0]
    assert best.probability > 0.95
    assert off(best, OUTLINES[L_SHAPE]) < 0.3
    assert (best.building, best.osm, best.level) == ("Stadtbibliothek", "way/7", "0")
    assert [p.osm for p in shown] == ["way/7"]
    assert len(best.residuals) > 10
    assert max(best.residuals) < 1.0
    assert np.linalg.eigvalsh(best.covariance).min() > 0
    assert best.covariance[2, 2] == UNKNOWN_HEIGHT**2
    assert notes == ()


def test_turns_of_a_square_are_told_until_an_entrance_tells(scenes, tmp_path):
    scene, corners = scenes[SQUARE], OUTLINES[SQUARE]
    found, notes, _ = fit_building(scene, extract(tmp_path / "a.osm", corners), "Stadtbibliothek")
    assert len(found) == 4
    assert min(a.probability for a in found) > 0.1
    assert "4 ways" in notes[0]
    assert min(off(a, corners) for a in found) < 0.3
    entrance = (6.5 * 0.6, 0.5)
    file = extract(tmp_path / "b.osm", corners, [entrance])
    found = fit_building(scene, file, "Stadtbibliothek").anchors
    assert found[0].probability > 0.8
    assert off(found[0], corners) < 0.3


def test_a_rough_place_tells_the_turn_and_the_height(scenes, tmp_path):
    scene, corners = scenes[SQUARE], OUTLINES[SQUARE]
    file = extract(tmp_path / "a.osm", corners)
    spread = np.diag([9.0, 9.0, 4.0, 0.12])
    rough = replace(TRUE.shift_origin((2.0, -2.0, 0)), heading=TRUE.heading + 0.3, height=31.0)
    prior = replace(rough, covariance=spread, method="gps")
    (best, *_), _, _ = fit_building(scene, file, "Stadtbibliothek", prior=prior)
    assert best.probability > 0.95
    assert off(best, corners) < 0.3
    assert (best.height, best.covariance[2, 2], best.method) == (31.0, 4.0, "building and gps")
    far = replace(prior, longitude=prior.longitude + 1e-3)
    with pytest.raises(OptionError, match=r"fit the building 6\d\.\d m and .* by gps"):
        fit_building(scene, file, "Stadtbibliothek", prior=far)


def test_a_flat_of_a_row_may_stand_between_its_ends(scenes, tmp_path):
    scene, far = scenes[SQUARE], 14.0
    (x0, y0), (x1, y1) = OUTLINES[SQUARE][0], OUTLINES[SQUARE][2]
    row = [(x0 - far, y0), (x1 + far, y0), (x1 + far, y1), (x0 - far, y1)]
    file = extract(tmp_path / "a.osm", row)
    found = fit_building(scene, file, "Stadtbibliothek").anchors
    middle = scene.bounds.mean(axis=0) * (1, 1, 0)
    true, rows = TRUE.shift_origin(-middle), np.ix_([0, 1], [0, 1])
    covered = 0.0
    for anchor in found:
        here = anchor.shift_origin(-middle)
        away = true.to_map((here.longitude, here.latitude, 0.0))[:2]
        turned = true.enu_from_map[:2, :2] @ away
        if turned @ np.linalg.solve(here.covariance[rows], turned) < 9:
            covered += anchor.probability
    assert covered > 0.5
    prior = replace(TRUE, covariance=np.diag([4.0, 4.0, 4.0, 0.1]), method="gps")
    best = fit_building(scene, file, "Stadtbibliothek", prior=prior).anchors[0]
    assert off(best, OUTLINES[SQUARE]) < 1.0
    assert 0.5 < np.sqrt(np.linalg.eigvalsh(best.covariance[rows])[1]) < 2.5


@pytest.mark.parametrize("corners", [
    [(0, 0), (5, 0), (5, 4), (0, 4)],
    [(0, 0), (60, 0), (60, 45), (0, 45)],
])  # fmt: skip
def test_another_building_is_refused(scenes, tmp_path, corners):
    file = extract(tmp_path / "a.osm", corners)
    with pytest.raises(OptionError, match="does not fit the building 'Stadtbibliothek'"):
        fit_building(scenes[L_SHAPE], file, "Stadtbibliothek")


def test_a_name_that_is_not_there_brings_those_like_it(scenes, tmp_path):
    file = extract(tmp_path / "a.osm", OUTLINES[L_SHAPE])
    with pytest.raises(OptionError, match="Is it 'Stadtbibliothek'"):
        fit_building(scenes[L_SHAPE], file, "Stadtbibliotek")
