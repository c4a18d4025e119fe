"""Pictures of scenes: plans on Earth, changes, views from above, overlays."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageColor
from tests.view.test_scene_plan import BOXES, QUADS, scene_of

from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera
from placegraph.errors import GeoPoseError, OptionError
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.change.align import make_rigid
from placegraph.indoor.mapping.change.changes import Change, Piece, SceneDiff
from placegraph.indoor.render import Rendering
from placegraph.view import draw_anchors, write_overlay
from placegraph.view.draw.canvas import Frame, Stroke, Text
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.change_plans import COLOR, change_marks, write_diff
from placegraph.view.scene.overlay import (
    EMPTY_COLOUR,
    FAINT,
    GAP,
    LINE,
    REACH,
    colour_objects,
    draw_outlines,
    draw_overlay,
    find_colour_borders,
    find_creases,
    find_edges,
)
from placegraph.view.scene.room_plan import RoomPlan, cut_section, fill_section, render_top_view
from placegraph.world.outlines import find_footprints
from placegraph_lab.worlds.flat.flat import Flat

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
    return find_footprints(file, "Hall")


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
    far = Anchor(9.9, 53.55, 0.0, 0.4, probability=0.4)
    drawn = draw_anchors(scene.anchored(HERE, far), tmp_path / "far.png")
    assert size(drawn) == size(bare)  # it is too far to be drawn
    assert len(count(drawn, "mode")) == 0


def test_a_map_that_stands_nowhere_is_refused(tmp_path):
    with pytest.raises(GeoPoseError, match="scene anchor"):
        draw_anchors(scene_of(BOXES), tmp_path / "a.png")


@pytest.fixture(scope="module")
def scene(study, tmp_path_factory):
    folder = tmp_path_factory.mktemp("diff-plan")
    study.furnish(np.random.default_rng(1)).write_glb(folder / "study.glb")
    return build_scene(folder / "study.glb", None)


@pytest.fixture
def changes(scene):
    def row(name):
        return scene.graph.ids[scene.graph.names.index(name)]

    box = np.array([[2.0, 1.0, 0.0], [2.5, 1.4, 0.6]])
    motion = make_rigid(np.eye(3), np.array([0.5, 0.25, 0.0]))
    return {
        "moved": Change("moved", "chair", 0.9, "", id=row("chair"), after_from_before=motion),
        "vanished": Change("vanished", "lamp", 0.9, "", id=row("lamp"), box=box),
        "appeared": Change(
            "appeared", "crate", 0.9, "", box=box,
            piece=Piece.box(*box, np.array([9, 9, 9], np.uint8)),
        ),
        "relabelled": Change("relabelled", "desk", 0.9, "", id=row("desk"), new_label="table", box=box),
    }  # fmt: skip


def test_an_arrow_leads_from_where_it_was_to_where_it_is(scene, changes):
    plan = RoomPlan(scene)
    rows = {id_: i for i, id_ in enumerate(scene.graph.ids)}
    strokes = [m for m in change_marks(plan, changes["moved"], rows) if isinstance(m, Stroke)]
    assert {s.color for s in strokes} <= {COLOR["moved"], "paper"}
    line = next(s for s in strokes if len(s.points) == 2)
    middle = plan.middle(rows[changes["moved"].id])
    np.testing.assert_allclose(line.points, [middle, middle + np.array([0.5, 0.25])], atol=1e-6)


@pytest.mark.parametrize("kind", ["vanished", "appeared", "relabelled"])
def test_every_kind_has_marks_of_its_colour(scene, changes, kind):
    marks = change_marks(RoomPlan(scene), changes[kind], {})
    assert COLOR[kind] in {getattr(m, "color", "") for m in marks}
    words = [m.text for m in marks if isinstance(m, Text)]
    assert words == {"appeared": ["crate"], "relabelled": ["table"]}.get(kind, [])


def test_the_picture_differs_from_that_of_nothing(scene, changes, tmp_path):
    def picture(*some):
        found = SceneDiff(tuple(some), (), (), np.eye(4), "", "study", "later")
        with Image.open(write_diff(scene, found, tmp_path / "d.png", width=600)) as image:
            return np.asarray(image.convert("RGB")).astype(int)

    plain, drawn = picture(), picture(*changes.values())
    assert plain.shape == drawn.shape
    assert np.count_nonzero(np.abs(plain - drawn).sum(axis=2) > 60) > 300
    with pytest.raises(OptionError):
        write_diff(scene, SceneDiff((), (), (), np.eye(4), ""), tmp_path / "no.png", width=3)


def box(low, high):
    """Vertices (8, 3) and triangles (12, 3) of a closed box that faces outwards."""
    low, high = np.array(low, float), np.array(high, float)
    bits = np.array([(i & 1, i >> 1 & 1, i >> 2) for i in range(8)])
    quads = np.array(QUADS)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return (low + bits * (high - low)).astype(np.float32), triangles.astype(np.int32)


def joined(*meshes):
    counts = np.cumsum([0, *(len(v) for v, _ in meshes)])
    vertices = np.concatenate([v for v, _ in meshes])
    return vertices, np.concatenate([t + n for (_, t), n in zip(meshes, counts, strict=False)])


def rotate_mesh(mesh, angle):
    vertices, triangles = mesh
    c, s = np.cos(angle), np.sin(angle)
    return (vertices @ np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)])).astype(np.float32), triangles


def signed_area(segments):
    """Area to the left of closed outlines."""
    (ax, ay), (bx, by) = segments[:, 0].T, segments[:, 1].T
    return float((ax * by - bx * ay).sum() / 2)


def test_the_highest_is_on_top():
    vertices, triangles = joined(box((0, 0, 0), (4, 4, 1)), box((2, 2, 0), (3, 3, 2)))
    frame = Frame((2.0, 2.0), 10.0, 60, 60)
    view = render_top_view(vertices, triangles, np.zeros(len(triangles), np.float32), frame)
    of_small = view.triangle >= 12
    assert (view.triangle >= 0).sum() == pytest.approx(1600, abs=82)
    assert of_small.sum() == pytest.approx(100, abs=22)
    rows, columns = np.nonzero(of_small)
    # x 2 to 3 lies right of the middle, y 2 to 3 above it
    assert (columns.min(), columns.max()) == (pytest.approx(30, abs=1), pytest.approx(39, abs=1))
    assert (rows.min(), rows.max()) == (pytest.approx(20, abs=1), pytest.approx(29, abs=1))
    assert view.height[25, 35] == pytest.approx(2.0)
    assert view.height[45, 15] == pytest.approx(1.0)
    assert view.height[0, 0] == -np.inf


def test_a_lift_decides_what_is_on_top_and_leaves_out():
    vertices, triangles = joined(box((0, 0, 0), (4, 4, 3)), box((1, 1, 0), (3, 3, 1)))
    frame = Frame((2.0, 2.0), 10.0, 40, 40)
    lift = np.zeros(24, np.float32)
    lift[12:] = 5.0
    view = render_top_view(vertices, triangles, lift, frame)
    assert view.triangle[20, 20] >= 12
    assert view.height[20, 20] == pytest.approx(1.0), "the lift is no part of the height"
    lift[:12] = -np.inf
    assert render_top_view(vertices, triangles, lift, frame).triangle[2, 2] == -1


def test_walls_of_a_scan_are_lines():
    vertices = np.array([(0, 0, 0), (3, 1, 0), (3, 1, 2), (0, 0, 2)], np.float32)
    triangles = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    frame = Frame((1.5, 0.5), 20.0, 80, 40)
    seen = render_top_view(vertices, triangles, np.zeros(2, np.float32), frame).triangle >= 0
    rows, columns = np.nonzero(seen)
    along = np.polyfit(columns, rows, 1)
    assert along[0] == pytest.approx(-1 / 3, abs=0.02)
    assert 60 <= seen.sum() <= 130


def test_nothing_of_nothing():
    frame = Frame((0.0, 0.0), 10.0, 20, 10)
    vertices, triangles = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)
    assert (
        render_top_view(vertices, triangles, np.zeros(0, np.float32), frame).triangle == -1
    ).all()
    segments = cut_section(vertices, triangles, 1.0)
    assert segments.shape == (0, 2, 2)
    assert not fill_section(segments, frame).any()


@given(
    st.floats(-3, 3), st.floats(-3, 3), st.floats(0.3, 2), st.floats(0.3, 2), st.floats(-3.2, 3.2)
)
def test_a_cut_box_is_its_footprint(x, y, wide, deep, angle):
    vertices, triangles = rotate_mesh(box((x, y, 0), (x + wide, y + deep, 2)), angle)
    segments = cut_section(vertices, triangles, 1.0)
    assert signed_area(segments) == pytest.approx(wide * deep, rel=1e-4)
    frame = Frame(tuple(segments.mean(axis=(0, 1)).tolist()), 40.0, 160, 160)
    inside = fill_section(segments, frame)
    assert inside.sum() / 1600 == pytest.approx(wide * deep, abs=0.06 * (wide + deep))


def test_what_lies_above_or_below_is_not_cut_and_walls_in_walls_leave_no_hole():
    beam = box((0, 0, 2), (4, 1, 3))
    step = box((0, 2, 0), (4, 3, 0.5))
    vertices, triangles = joined(beam, step, box((1, 0.2, 0), (2, 0.8, 3)))
    assert signed_area(cut_section(vertices, triangles, 1.0)) == pytest.approx(0.6, rel=1e-5)
    segments = cut_section(*joined(box((0, 0, 0), (4, 1, 3)), box((1, 0.5, 0), (2, 3, 3))), 1.0)
    frame = Frame((2.0, 1.5), 20.0, 100, 80)
    assert fill_section(segments, frame).sum() / 400 == pytest.approx(4 + 2, rel=0.05)


def test_rooms_whose_walls_face_inwards_are_not_filled_and_gaps_smear_nothing():
    vertices, triangles = box((0, 0, 0), (4, 3, 3))
    segments = cut_section(vertices, triangles[:, ::-1], 1.0)
    assert signed_area(segments) == pytest.approx(-12.0, rel=1e-5)
    assert not fill_section(segments, Frame((2.0, 1.5), 20.0, 100, 80)).any()
    segments = cut_section(*box((0, 0, 0), (2, 2, 3)), 1.0)
    right = segments[..., 0].min(axis=1) > 1.9
    frame = Frame((3.0, 1.0), 20.0, 200, 60)
    inside = fill_section(segments[~right], frame)
    assert not inside[:, frame.width // 2 :].any()


H, W = 60, 96


def corner(*, step=0.0, objects=0, hole=False):
    """Two walls that meet upright at column W / 2; `step`: the right one stands nearer [m]."""
    column = np.broadcast_to(np.arange(W) + 0.5 - W / 2, (H, W))
    slope = np.where(column < 0, 0.9, -0.9)
    # the plane z = 4 + s x z' has the inverse depth (1 - s x') / 4: linear along the row
    inverse = (1.0 - slope * column / 100.0) / (4.0 - step * (column > 0))
    depth = (1.0 / inverse).astype(np.float32)
    normals = np.zeros((H, W, 3), np.float32)
    angle = np.arctan(slope)
    normals[..., 0], normals[..., 2] = np.sin(angle), -np.cos(angle)
    ids = np.where(column > 0, objects, 0).astype(np.int32)
    colour = np.full((H, W, 3), 180, np.uint8)
    triangles = np.zeros((H, W), np.int32)
    if hole:
        for values, nothing in ((depth, np.nan), (ids, -1), (triangles, -1), (normals, np.nan)):
            values[10:30, 70:90] = nothing
    return Rendering(colour, depth, ids, triangles, np.zeros((H, W, 3), np.float32)), normals


def columns(marked):
    return set(np.nonzero(marked.any(axis=0))[0].tolist())


def test_walls_meet_in_one_line_and_a_hole_in_the_map_is_no_edge():
    drawn, normals = corner()
    found = find_creases(normals)
    assert columns(found) <= {W // 2 - 1, W // 2}
    assert found[REACH:-REACH].any(axis=1).all(), "from top to bottom"
    assert found.sum(axis=1).max() == 1, "a thin line"
    assert columns(find_edges(drawn, normals)) <= {W // 2 - 1, W // 2}
    drawn, normals = corner(hole=True)
    assert columns(find_edges(drawn, normals)) <= {W // 2 - 1, W // 2}
    assert not find_colour_borders(drawn).any()


def test_objects_and_jumps_are_outlined():
    flat = np.tile(np.array([0, 0, -1], np.float32), (H, W, 1))
    for drawn, _ in (corner(objects=1), corner(step=1.0)):
        found = find_edges(drawn, flat)
        assert columns(found) <= {W // 2 - 1, W // 2}
        assert found.any(axis=1).mean() > 0.9
    assert not find_edges(corner(step=0.02)[0], flat)[:, : W // 2 - 4].any()


def test_borders_of_colours_and_no_specks():
    drawn, normals = corner()
    drawn.colour[:, 30:] = 60
    found = find_colour_borders(drawn)
    assert columns(found) <= {28, 29, 30, 31}
    assert found.any(axis=1).mean() > 0.85
    drawn.colour[:, 30:] = 178
    assert not find_colour_borders(drawn).any(), "too faint to see"
    drawn.objects[30, 20] = 5
    assert columns(find_edges(drawn, normals)) <= {W // 2 - 1, W // 2}


def test_lines_are_drawn_on_the_query():
    query = np.full((H, W, 3), 100, np.uint8)
    edge, border = np.zeros((2, H, W), bool)
    edge[:, 20], border[:, 60] = True, True
    shown = draw_outlines(query, edge, border)
    assert (shown[:, 20] == LINE).all()
    nearer = np.abs(shown[0, 60].astype(float) - FAINT).max()
    assert nearer < np.abs(query[0, 60].astype(float) - FAINT).max()
    assert (shown[:, 40] == 80).all(), "dimmed"
    assert (shown[:, 19] < 80).all(), "a dark rim sets the line off"
    assert (query == 100).all()


def test_objects_have_colours_of_their_own():
    ids = np.arange(-1, 199, dtype=np.int32).reshape(10, 20)
    picture = colour_objects(ids)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 200
    assert tuple(picture[0, 0]) == EMPTY_COLOUR
    again = colour_objects(ids[5:])
    np.testing.assert_array_equal(again, picture[5:])
    apart = picture.reshape(-1, 3).astype(int)[1:]
    assert np.abs(apart[1:] - apart[:-1]).max(axis=1).min() > 40, "neighbours are told apart"
    shaded = colour_objects(ids, np.full((10, 20, 3), np.nan, np.float32))
    np.testing.assert_array_equal(shaded, picture)


def test_four_pictures_in_one():
    drawn, normals = corner(hole=True)
    query = np.full((H, W, 3), (10, 200, 30), np.uint8)
    sheet = np.asarray(draw_overlay(query, drawn, normals))
    assert sheet.shape[1] == 2 * W + GAP
    band = (sheet.shape[0] - GAP) // 2 - H
    assert (sheet[band : band + H, :W] == query).all()
    map_ = sheet[band : band + H, W + GAP :]
    assert (map_[~drawn.mask] == EMPTY_COLOUR).all()
    assert (map_[drawn.mask] == 180).all()
    lower = sheet[2 * band + H + GAP :]
    assert (lower[:, :W] == LINE).all(axis=-1).any()
    assert {tuple(c) for c in lower[:, W + GAP :].reshape(-1, 3)} == {
        (10, 200, 30), (180, 180, 180), EMPTY_COLOUR,
    }  # fmt: skip
    assert (sheet[:band] < 100).any(), "captions"
    for colour in (LINE, FAINT):
        key = sheet[band + H + GAP : 2 * band + H + GAP, :W]
        assert (key == colour).all(axis=-1).sum() > 6, "what the lines are"
    with pytest.raises(OptionError, match="query's camera"):
        draw_overlay(np.zeros((H, W - 1, 3), np.uint8), drawn, normals)


def test_two_more_pictures_show_the_pose_before():
    drawn, normals = corner()
    query = np.full((H, W, 3), (10, 200, 30), np.uint8)
    plain = np.asarray(draw_overlay(query, drawn, normals))
    before, before_normals = corner(objects=1)
    before.colour[:] = 90
    sheet = np.asarray(draw_overlay(query, drawn, normals, before=(before, before_normals)))
    tall = (len(plain) + GAP) // 2  # a row with its caption and the gap
    assert len(sheet) == 3 * tall - GAP
    captions = tall - GAP - H
    np.testing.assert_array_equal(sheet[: tall + captions + H], plain[: tall + captions + H])
    last = sheet[2 * tall + captions :]
    assert (last[:, :W] == LINE).all(axis=-1).any()
    assert {tuple(c) for c in last[:, W + GAP :].reshape(-1, 3)} == {(10, 200, 30), (90, 90, 90)}
    with pytest.raises(OptionError, match="query's camera"):
        draw_overlay(query[:-1], drawn, normals, before=(before, before_normals))


ROOM = """
[flat]
name = Cell
height = 2.6
[drawing]
##########
#BB    TT#
#      TT#
#   1    #
##########
[legend]
1 room: label=study walls=wallpaper palegoldenrod floor=parquet sienna
B shelf: label=bookcase height=2.1
T table: label=desk look=wood burlywood
"""
CAMERA = Camera(W, H, 60.0, 60.0, W / 2, H / 2)


@pytest.fixture(scope="module")
def overlay_case(tmp_path_factory):
    """A room, a pose in it and one beside it, and frames: the third shows the room from the pose."""
    folder = tmp_path_factory.mktemp("overlay")
    interior = Flat.parse(ROOM).furnish(np.random.default_rng(0))
    scene = build_scene(interior.write_glb(folder / "room.glb"), None)
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # along y
    pose[:3, 3] = (*scene.bounds[:, :2].mean(axis=0), 1.4)
    beside = pose.copy()
    beside[0, 3] += 0.15
    picture = scene.render(pose, CAMERA).colour
    frames = [
        SimpleNamespace(index=k, camera=CAMERA, rgb=lambda k=k: picture if k == 2 else None)
        for k in range(4)
    ]
    return SimpleNamespace(scene=scene, pose=pose, beside=beside, frames=frames)


def estimate_at(pose, *, before=None, accepted=True):
    def mode(matrix):
        return PoseMode(matrix, np.zeros(4), np.eye(6), 1.0, "room", matrix)

    refinement = None
    if before is not None:
        refinement = Refinement(accepted, "Drawn.", mode(before), before[None])
    return PoseEstimate(
        Status.OK, (mode(pose),), "Drawn.", trajectory=pose[None], frames=np.array([2]),
        refinement=refinement,
    )  # fmt: skip


def read(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_an_estimate_is_laid_over_its_last_frame(overlay_case, tmp_path):
    def drawn(**how):
        path = tmp_path / "look.png"
        estimate = estimate_at(overlay_case.pose, **how)
        assert write_overlay(overlay_case.scene, estimate, overlay_case.frames, path) == path
        return read(path)

    plain = drawn()
    assert plain.shape[1] == 2 * W + GAP
    band = (len(plain) + GAP) // 2 - GAP - H
    one, other = plain[band : band + H, :W], plain[band : band + H, W + GAP :]
    assert np.abs(one.astype(int) - other).max() <= 2, "the map from the pose is what was seen"
    moved = drawn(before=overlay_case.beside)
    tall = (len(plain) + GAP) // 2
    assert len(moved) == len(plain) + tall
    np.testing.assert_array_equal(moved[: len(plain)], plain)
    assert (moved[2 * tall + band :] != plain[tall + band :]).any(), "from beside"
    np.testing.assert_array_equal(drawn(before=overlay_case.pose, accepted=False), plain)


def test_what_cannot_be_shown(overlay_case, tmp_path):
    nowhere = PoseEstimate(Status.LOST, (), "It is dark.")
    with pytest.raises(OptionError, match=r"The estimate has no pose to show\. It is"):
        write_overlay(overlay_case.scene, nowhere, overlay_case.frames, tmp_path / "no.png")
    with pytest.raises(OptionError, match="Frame 2"):
        write_overlay(
            overlay_case.scene,
            estimate_at(overlay_case.pose),
            overlay_case.frames[:2],
            tmp_path / "no.png",
        )
    assert not list(tmp_path.iterdir())
