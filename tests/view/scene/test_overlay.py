"""Overlays: lines lie where the map's edges are, and nowhere else."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.build import build_scene
from placegraph.indoor.render import Rendering
from placegraph.view import write_overlay
from placegraph.view.scene.overlay import (
    BEFORE,
    CAPTIONS,
    FAINT,
    GAP,
    LINE,
    NOTHING,
    REACH,
    borders,
    checkerboard,
    colours_of,
    creases,
    edges,
    outlined,
    overlay,
)
from placegraph_lab.worlds.flat.flat import Flat

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


def test_walls_meet_in_one_line():
    drawn, normals = corner()
    found = creases(normals)
    assert columns(found) <= {W // 2 - 1, W // 2}
    assert found[REACH:-REACH].any(axis=1).all(), "from top to bottom"
    assert found.sum(axis=1).max() == 1, "a thin line"
    assert columns(edges(drawn, normals)) <= {W // 2 - 1, W // 2}


def test_objects_and_jumps_are_outlined():
    flat = np.tile(np.array([0, 0, -1], np.float32), (H, W, 1))
    for drawn, _ in (corner(objects=1), corner(step=1.0)):
        found = edges(drawn, flat)
        assert columns(found) <= {W // 2 - 1, W // 2}
        assert found.any(axis=1).mean() > 0.9
    assert not edges(corner(step=0.02)[0], flat)[:, : W // 2 - 4].any()


def test_a_hole_in_the_map_is_no_edge():
    drawn, normals = corner(hole=True)
    assert columns(edges(drawn, normals)) <= {W // 2 - 1, W // 2}
    assert not borders(drawn).any()


def test_borders_of_colours():
    drawn, _ = corner()
    drawn.colour[:, 30:] = 60
    found = borders(drawn)
    assert columns(found) <= {28, 29, 30, 31}
    assert found.any(axis=1).mean() > 0.85
    drawn.colour[:, 30:] = 178
    assert not borders(drawn).any(), "too faint to see"


def test_specks_are_left_out():
    drawn, normals = corner()
    drawn.objects[30, 20] = 5
    assert columns(edges(drawn, normals)) <= {W // 2 - 1, W // 2}


def test_lines_are_drawn_on_the_query():
    query = np.full((H, W, 3), 100, np.uint8)
    edge, border = np.zeros((2, H, W), bool)
    edge[:, 20], border[:, 60] = True, True
    shown = outlined(query, edge, border)
    assert (shown[:, 20] == LINE).all()
    nearer = np.abs(shown[0, 60].astype(float) - FAINT).max()
    assert nearer < np.abs(query[0, 60].astype(float) - FAINT).max()
    assert (shown[:, 40] == 80).all(), "dimmed"
    assert (shown[:, 19] < 80).all(), "a dark rim sets the line off"
    assert (query == 100).all()


def test_squares_in_turn():
    board = checkerboard(np.zeros((H, W, 3), np.uint8), np.full((H, W, 3), 255, np.uint8))
    assert board.mean() == pytest.approx(127.5, abs=20)
    side = W // 8
    assert board[0, [0, side, 2 * side], 0].tolist() == [0, 255, 0]
    assert board[[side, 2 * side], 0, 0].tolist() == [255, 0]


def test_objects_have_colours_of_their_own():
    ids = np.arange(-1, 199, dtype=np.int32).reshape(10, 20)
    picture = colours_of(ids)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 200
    assert tuple(picture[0, 0]) == NOTHING
    again = colours_of(ids[5:])
    np.testing.assert_array_equal(again, picture[5:])
    apart = picture.reshape(-1, 3).astype(int)[1:]
    assert np.abs(apart[1:] - apart[:-1]).max(axis=1).min() > 40, "neighbours are told apart"
    shaded = colours_of(ids, np.full((10, 20, 3), np.nan, np.float32))
    np.testing.assert_array_equal(shaded, picture)


def test_four_pictures_in_one():
    drawn, normals = corner(hole=True)
    query = np.full((H, W, 3), (10, 200, 30), np.uint8)
    sheet = np.asarray(overlay(query, drawn, normals))
    assert sheet.shape[1] == 2 * W + GAP
    band = (sheet.shape[0] - GAP) // 2 - H
    assert (sheet[band : band + H, :W] == query).all()
    map_ = sheet[band : band + H, W + GAP :]
    assert (map_[~drawn.mask] == NOTHING).all()
    assert (map_[drawn.mask] == 180).all()
    lower = sheet[2 * band + H + GAP :]
    assert (lower[:, :W] == LINE).all(axis=-1).any()
    assert {tuple(c) for c in lower[:, W + GAP :].reshape(-1, 3)} == {
        (10, 200, 30), (180, 180, 180), NOTHING,
    }  # fmt: skip
    assert (sheet[:band] < 100).any(), "captions"
    assert len(CAPTIONS) == 4


def test_pictures_of_other_sizes_are_refused():
    drawn, normals = corner()
    with pytest.raises(OptionError, match="query's camera"):
        overlay(np.zeros((H, W - 1, 3), np.uint8), drawn, normals)


def test_two_more_pictures_show_the_pose_before():
    drawn, normals = corner()
    query = np.full((H, W, 3), (10, 200, 30), np.uint8)
    plain = np.asarray(overlay(query, drawn, normals))
    before, before_normals = corner(objects=1)
    before.colour[:] = 90
    sheet = np.asarray(overlay(query, drawn, normals, before=(before, before_normals)))
    tall = (len(plain) + GAP) // 2  # a row with its caption and the gap
    assert len(sheet) == 3 * tall - GAP
    captions = tall - GAP - H
    np.testing.assert_array_equal(sheet[: tall + captions + H], plain[: tall + captions + H])
    last = sheet[2 * tall + captions :]
    assert (last[:, :W] == LINE).all(axis=-1).any()
    assert {tuple(c) for c in last[:, W + GAP :].reshape(-1, 3)} == {(10, 200, 30), (90, 90, 90)}
    assert len(BEFORE) == 2
    with pytest.raises(OptionError, match="query's camera"):
        overlay(query[:-1], drawn, normals, before=(before, before_normals))


# --- of an estimate ---


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
def seen(tmp_path_factory):
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


def test_an_estimate_is_laid_over_its_last_frame(seen, tmp_path):
    def drawn(**how):
        path = tmp_path / "look.png"
        estimate = estimate_at(seen.pose, **how)
        assert write_overlay(seen.scene, estimate, seen.frames, path) == path
        return read(path)

    plain = drawn()
    assert plain.shape[1] == 2 * W + GAP
    band = (len(plain) + GAP) // 2 - GAP - H
    one, other = plain[band : band + H, :W], plain[band : band + H, W + GAP :]
    assert np.abs(one.astype(int) - other).max() <= 2, "the map from the pose is what was seen"
    moved = drawn(before=seen.beside)
    tall = (len(plain) + GAP) // 2
    assert len(moved) == len(plain) + tall
    np.testing.assert_array_equal(moved[: len(plain)], plain)
    assert (moved[2 * tall + band :] != plain[tall + band :]).any(), "from beside"
    np.testing.assert_array_equal(drawn(before=seen.pose, accepted=False), plain)


def test_what_cannot_be_shown(seen, tmp_path):
    nowhere = PoseEstimate(Status.LOST, (), "It is dark.")
    with pytest.raises(OptionError, match="no pose to show: It is dark"):
        write_overlay(seen.scene, nowhere, seen.frames, tmp_path / "no.png")
    with pytest.raises(OptionError, match="Frame 2"):
        write_overlay(seen.scene, estimate_at(seen.pose), seen.frames[:2], tmp_path / "no.png")
    assert not list(tmp_path.iterdir())
