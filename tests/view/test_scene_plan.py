"""Plans of rooms, and pictures of an estimate in them: checked by their pixels."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageColor

from placegraph.core.estimate import Evidence, ObjectRef, PassRecord, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph.view import draw_scene, write_plan, write_plan_animation
from placegraph.view.draw.canvas import Disc, Frame, choose_face
from placegraph.view.draw.lettering import OccupiedPlaces, covering_discs
from placegraph.view.draw.painter import SUPERSAMPLE, paint_picture
from placegraph.view.draw.style import PALETTE
from placegraph.view.scene.frame_marks import mark_agreement
from placegraph.view.scene.plan import (
    CAPTION,
    FOOT,
    GAP,
    HEAD,
    MAX_FRAMES,
    Layout,
    core_bounds,
    evidence_marks,
    evidence_rows,
    particle_levels,
    particle_marks,
    trajectory_marks,
    view_ring,
)
from placegraph.view.scene.room_plan import (
    ROOM_PAINTS,
    RoomPlan,
    paint_room,
    plain_words,
    room_paint,
)

BOXES = {
    # label: lower corner, upper corner
    "floor": ((0, 0, -0.1), (8, 5, 0)),
    "ceiling": ((0, 0, 2.6), (8, 5, 2.7)),
    "wall west": ((-0.2, 0, 0), (0, 5, 2.6)),
    "wall east": ((8, 0, 0), (8.2, 5, 2.6)),
    "wall beam": ((4, 0, 2.2), (4.3, 5, 2.6)),
    "KitchenTable": ((5, 3, 0), (7, 4, 0.8)),
    "Sofa_01": ((1, 1, 0), (3, 2, 0.9)),
    "lamp": ((5.8, 3.3, 1.8), (6.2, 3.7, 2.4)),
    "tall wardrobe": ((0.1, 4, 0), (1.1, 4.9, 2.2)),
}
"""A room of 8 x 5 m, open to the north and the south."""
CORNERS = np.array([(i & 1, i >> 1 & 1, i >> 2) for i in range(8)])
QUADS = ((0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6), (1, 0, 2, 3), (4, 5, 7, 6))
UPRIGHT = level_from_camera((0.0, 1.0, 0.0))


def scene_of(boxes, shift=(0.0, 0.0, 0.0), **options):
    vertices, triangles, owners = [], [], []
    for row, ends in enumerate(boxes.values()):
        low, high = np.array(ends, float) + shift
        for a, b, c, d in QUADS:
            triangles += [(8 * row + a, 8 * row + b, 8 * row + c)]
            triangles += [(8 * row + a, 8 * row + c, 8 * row + d)]
            owners += [row, row]
        vertices.append(low + CORNERS * (high - low))
    mesh = Mesh.plain(np.concatenate(vertices), np.array(triangles), np.array(owners))
    labels = [label.split()[0] if label.startswith("wall ") else label for label in boxes]
    return SceneMap.create(
        mesh, [str(row) for row in range(len(boxes))], labels, floor=shift[2], **options
    )


@pytest.fixture(scope="module")
def scene():
    return scene_of(BOXES, scene="room")


@pytest.fixture(scope="module")
def plan(scene):
    return RoomPlan(scene)


def light(name):
    return ImageColor.getrgb(ROOM_PAINTS[name].light)


def pixel(picture, frame, at):
    """Colour of a picture of a frame, `SUPERSAMPLE` times as large, at x, y [m]."""
    x, y = (frame.to_px(np.array(at, float)) * SUPERSAMPLE).astype(int)
    return tuple(int(c) for c in picture.pixels[y, x])


def near(color, other, tolerance=12):
    return max(abs(a - b) for a, b in zip(color, other, strict=True)) <= tolerance


def test_furniture_stands_where_it_is_walls_are_dark_and_beams_are_not_there(plan):
    frame = Frame.around(plan.bounds, 420, 280)
    picture = paint_room(plan, frame)
    assert picture.pixels.shape == (560, 840, 3)
    assert near(pixel(picture, frame, (6.0, 3.5)), light("table")), "not the lamp above it"
    assert near(pixel(picture, frame, (2.0, 1.5)), light("seat"))
    assert near(pixel(picture, frame, (0.6, 4.5)), light("storage")), "taller than the cut"
    assert near(pixel(picture, frame, (6.0, 1.5)), light("floor")), "y grows upwards"
    assert near(pixel(picture, frame, (2.0, 3.5)), light("floor")), "x grows to the right"
    for x in (-0.1, 8.1):
        assert pixel(picture, frame, (x, 2.5)) == light("wall")
    assert near(pixel(picture, frame, (4.15, 2.5)), light("floor"))
    assert pixel(picture, frame, (4.15, 5.3)) != light("wall")


def test_a_dark_plan_is_dark(plan):
    frame = Frame.around(plan.bounds, 200, 150)
    assert paint_room(plan, frame).pixels.mean() > 180
    assert paint_room(plan, frame, dark=True).pixels.mean() < 90


def test_a_scan_without_labels_shows_its_own_colours():
    boxes = {k: BOXES[k] for k in ("floor", "wall west", "wall east", "KitchenTable", "ceiling")}
    mesh = scene_of(boxes).mesh
    colours = np.full((len(mesh.vertices), 3), 200, np.uint8)
    colours[24:32] = (40, 200, 60)  # the table
    scan = Mesh.plain(mesh.vertices, mesh.triangles, None, colours)
    plan = RoomPlan(SceneMap.create(scan, ["all"], ["scan"], floor=0.0))
    frame = Frame.around(plan.bounds, 420, 280)
    picture = paint_room(plan, frame)
    red, green, blue = pixel(picture, frame, (6.0, 3.5))
    assert green > red + 40
    assert green > blue + 40
    assert pixel(picture, frame, (-0.0, 2.5)) == light("wall")
    assert plan.names(frame, None, None) == []


def named(plan, count, **options):
    """Names on a plan 1200 px wide, and the discs that cover each."""
    face = choose_face(["chair", "mug"])
    frame = Frame.around(plan.bounds, 1200, 800)
    texts = plan.names(frame, face, OccupiedPlaces(), **options)
    assert len(texts) <= count
    wide = [face.width(text.text, text.size) for text in texts]
    discs = [
        np.array(covering_discs(text, width, frame.scale))
        for text, width in zip(texts, wide, strict=True)
    ]
    return texts, discs, frame


def test_small_things_are_named_beside_where_they_stand():
    mugs = {f"mug_{k}": ((2 * k, 1, 0), (2 * k + 0.1, 1.1, 0.1)) for k in range(4)}
    plan = RoomPlan(scene_of(BOXES | mugs))
    assert "mug" not in {text.text for text in named(plan, 99)[0]}
    texts, _, frame = named(plan, 99, small=True)
    assert sum(text.text == "mug" for text in texts) == 4
    for text in texts:
        x, y = frame.to_px(np.asarray(text.at)) + text.shift
        assert 0 < x < 1200
        assert 0 < y < 800


def test_names_of_five_hundred_things_do_not_overlap(rng):
    at = rng.uniform(0, [36, 23], (500, 2))
    ends = at + rng.uniform(0.1, 1.6, (500, 2))
    boxes = {
        f"{'chair' if k % 2 else 'mug'}_{k}": ((*low, 0), (*high, 1))
        for k, (low, high) in enumerate(zip(at, ends, strict=True))
    }
    texts, discs, _ = named(RoomPlan(scene_of(boxes)), 500, small=True)
    assert len(texts) > 250
    owner = np.repeat(np.arange(len(discs)), [len(d) for d in discs])
    every = np.concatenate(discs)
    apart = np.linalg.norm(every[:, None, :2] - every[None, :, :2], axis=2)
    reach = every[:, None, 2] + every[None, :, 2]
    assert np.all((apart >= 0.95 * reach) | (owner[:, None] == owner[None]))


def test_of_merged_scenes_one_is_drawn(scene):
    both = scene_of(
        BOXES | {"chair": ((20, 0, 0), (21, 1, 1)), "Floor": ((19, -1, -1), (24, 3, 0))}
    )
    which = np.zeros(len(both), np.int32)
    which[-2:] = 1
    merged = replace(
        both, scenes=("room", "next"), scene_of=which, floors=np.zeros(2),
        scene_from_map=np.tile(np.eye(4), (2, 1, 1)),
    )  # fmt: skip
    assert RoomPlan(merged, 0).bounds == RoomPlan(scene).bounds
    west, south, east, north = RoomPlan(merged, 1).bounds
    assert (west, east) == (pytest.approx(18.65), pytest.approx(24.35))
    assert (south, north) == (pytest.approx(-1.35), pytest.approx(3.35))


@given(st.floats(0.5, 7.5), st.floats(2.1, 2.9), st.floats(-np.pi, np.pi))
def test_sight_ends_at_walls(x, y, angle):
    plan = RoomPlan(scene_of({k: BOXES[k] for k in ("floor", "wall west", "wall east")}))
    (far,) = plan.view_range(np.array([x, y]), np.array([angle]), 3.0)
    cos, sin = np.cos(angle), np.sin(angle)
    wall = (8.0 - x) / cos if cos > 1e-9 else (x / -cos if cos < -1e-9 else np.inf)
    inside = 0.01 < y + wall * sin < 4.99 if np.isfinite(wall) else False
    if inside and wall < 2.99:
        assert far == pytest.approx(wall, abs=2e-3)
    elif not inside and abs(y + wall * sin - 2.5) > 2.6:
        assert far == 3.0


def test_a_wedge_opens_where_the_camera_looks(plan):
    pose = np.array([2.0, 3.0, 1.5, np.pi / 2])
    ring = view_ring(plan, pose, 1.0, reach=1.2)
    assert (ring[0] == ring[-1]).all()
    middle = ring[1:-1].mean(axis=0)
    assert middle[0] == pytest.approx(2.0, abs=1e-6)
    assert middle[1] > 3.5


@pytest.mark.parametrize(
    ("label", "paint", "words"),
    [
        ("KitchenCabinet", "storage", "kitchen cabinet"), ("coffee_table", "table", "coffee table"),
        ("CoffeeTable_01_001", "table", "coffee table"), ("HouseWall", "wall", "house wall"),
        ("wall /other room", "wall", "wall other room"), ("floor lamp", "thing", "floor lamp"),
        ("wall clock", "thing", "wall clock"), ("chairs", "seat", "chairs"),
        ("TV", "appliance", "tv"), ("TVCabinet", "storage", "tv cabinet"),
        ("Airconditioner", "appliance", "airconditioner"), ("ceiling", "ceiling", "ceiling"),
        ("", "thing", ""), ("42", "thing", ""), ("стул", "thing", "стул"),
    ],
)  # fmt: skip
def test_labels(label, paint, words):
    assert room_paint(label) == paint
    assert plain_words(label) == words


def test_levels_tell_crowds_from_stray_ones():
    rng = np.random.default_rng(0)
    crowd = np.column_stack([rng.normal(2, 0.05, (300, 2)), np.full(300, 1.6), np.zeros(300)])
    stray = np.column_stack(
        [rng.uniform(0, 30, (300, 2)), np.full(300, 1.6), rng.uniform(-3, 3, 300)]
    )
    level = particle_levels(np.concatenate([crowd, stray]), np.full(600, 1 / 600))
    assert level.min() >= 0.0
    assert level.max() <= 1.0
    assert level[:300].min() > level[300:].mean() + 0.2
    light = np.concatenate([np.full(300, 1e-9), np.full(300, 1.0)])
    assert particle_levels(np.concatenate([crowd, stray]), light)[:300].mean() < 0.1
    assert particle_levels(np.zeros((0, 4)), np.zeros(0)).shape == (0,)
    assert (particle_levels(np.zeros((3, 4)), np.zeros(3)) == 0.0).all()


@given(st.integers(-3, 3), st.floats(-50, 50), st.floats(0.1, 10))
def test_levels_know_no_origin_and_no_unit(turns, shift, factor):
    rng = np.random.default_rng(1)
    poses = np.column_stack([rng.normal(0, 1, (50, 2)), np.ones(50), rng.uniform(-3, 3, 50)])
    weights = rng.uniform(0.1, 1, 50)
    moved = poses + np.array([shift, shift, 0.0, turns * 2 * np.pi])
    assert particle_levels(moved, weights * factor) == pytest.approx(
        particle_levels(poses, weights), abs=1e-6
    )


def test_particles_appear_where_they_are():
    frame = Frame((0.0, 0.0), 20.0, 200, 100)
    item = particle_marks(
        np.array([(2.0, 1.0, 1.5, 0.0), (-3.0, -1.5, 1.5, 0.0)]), np.array([0.9, 0.1])
    )
    image = np.asarray(paint_picture([item], frame)).astype(int)
    paper = ImageColor.getrgb(PALETTE["land"][0])
    rows, columns = np.nonzero(np.abs(image - paper).max(axis=2) > 40)
    off = [
        np.hypot(columns - column, rows - row)
        for column, row in frame.to_px(np.array([(2.0, 1.0), (-3.0, -1.5)]))
    ]
    assert all((each < 8).sum() > 5 for each in off)
    assert np.all(np.min(off, axis=0) < 9)


def test_a_core_leaves_out_stray_particles():
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(1, 2, (1000, 2)), np.ones((1000, 2))])
    poses[:5] = 500.0
    bounds = core_bounds(poses, np.ones(1000))
    assert bounds == pytest.approx((1.05, 1.05, 1.95, 1.95), abs=0.05)
    assert core_bounds(poses, np.zeros(1000)) == bounds


def mode(x, y, yaw, probability, scene="room", evidence=()):
    pose = np.array([x, y, 1.6, yaw])
    covariance = np.diag([0.02, 0.01, 0.001, 1e-5, 1e-5, 0.001])
    matrix = pose_matrix(pose, UPRIGHT)
    return PoseMode(matrix, pose, covariance, probability, scene, matrix, explain=lambda: evidence)


def refs(*rows):
    return tuple(
        Evidence(f"object {row}", verdict, weight, (ObjectRef(str(row), "thing", ""),))
        for row, verdict, weight in rows
    )


def estimate_of(status, *modes, passes=0, steps=4):
    """Estimate whose camera goes to the right, with particles around it that gather."""
    rng = np.random.default_rng(0)
    way = [pose_matrix((2.0 + 0.4 * k, 2.8, 1.6, 0.3), UPRIGHT) for k in range(steps)]
    history = []
    for k in range(passes):
        records = []
        for index, matrix in enumerate(way):
            spread = 1.5 / (1 + k) ** 2
            xy = matrix[:2, 3] + rng.normal(0, spread, (400, 2))
            poses = np.column_stack([xy, np.full(400, 1.6), rng.normal(0.3, spread, 400)])
            records.append((10 + index, poses, np.full(400, 1 / 400)))
        history.append(PassRecord(20.0 / (k + 1), tuple(records)))
    return PoseEstimate(
        status=status, modes=modes, reason="Because.", trajectory=np.array(way),
        frames=np.arange(10, 10 + steps), history=tuple(history),
    )  # fmt: skip


BEST = mode(3.2, 2.8, 0.3, 0.9, evidence=refs((5, "for", 2.0), (6, "against", -1.0), (2, "for", 1)))
CASES = {
    "OK": estimate_of(Status.OK, BEST, passes=3),
    "coarse": estimate_of(Status.OK, BEST, passes=1),
    "no history": estimate_of(Status.OK, BEST),
    "AMBIGUOUS": estimate_of(Status.AMBIGUOUS, BEST, mode(6, 1, 2, 0.1), passes=2),
    "LOST": estimate_of(Status.LOST, passes=2),
    "one frame": estimate_of(Status.OK, BEST, steps=1, passes=2),
    "elsewhere": estimate_of(Status.OK, mode(500.0, 0.0, 0.0, 0.9, scene="unknown"), passes=1),
}


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def share(image, name, tolerance=10):
    """Number of pixels that have a colour of the palette."""
    color = np.array(ImageColor.getrgb(PALETTE[name][0]))
    return int((np.abs(image.astype(int) - color).max(axis=-1) <= tolerance).sum())


@pytest.mark.parametrize("case", CASES)
def test_pictures_of_all_kinds(case, scene, tmp_path):
    path = write_plan(scene, CASES[case], tmp_path / "plan.png", width=800)
    image = pixels(path)
    assert image.shape[1] == 800
    assert 200 < image.shape[0] < 1200
    assert path.stat().st_size < 1_000_000
    below = image[HEAD:]
    if case in ("OK", "coarse", "one frame", "no history"):
        assert share(below, "mode") > 60
        assert share(below, "for") > 20
    assert (share(image, "amber") > 200) == (case == "AMBIGUOUS")


def test_the_way_is_drawn_where_it_went(scene, tmp_path):
    estimate = CASES["no history"]
    image = pixels(write_plan(scene, estimate, tmp_path / "plan.png"))
    row = pixels(write_plan(scene, CASES["coarse"], tmp_path / "row.png"))
    assert image.shape[1] == row.shape[1] == 1200
    assert row.shape[0] > image.shape[0], "a row of particles above the plan"
    rows = pixels(write_plan(scene, CASES["OK"], tmp_path / "rows.png"))
    assert rows.shape[1] == 1600, "a row for each of several passes"
    plan = RoomPlan(scene)
    layout = Layout.of(plan.bounds, [])
    frame = Frame.around(plan.bounds, *layout.large)
    (x0, y0), (x1, y1) = (frame.to_px(m[:2, 3]) for m in estimate.trajectory[[0, -1]])
    assert x1 > x0
    assert y0 == pytest.approx(y1)
    for at in ((x0, y0), (x1, y1)):
        row, column = round(at[1]) + HEAD, round(at[0])
        assert share(image[row - 4 : row + 5, column - 4 : column + 5], "mode", 40) > 4
    flipped = HEAD + frame.height - round(y0)
    assert share(image[flipped - 4 : flipped + 5, round(x0) - 4 : round(x0) + 5], "mode", 40) == 0


def test_a_long_way_is_thinned():
    marks = trajectory_marks(np.broadcast_to(np.eye(4), (3 * MAX_FRAMES, 4, 4)), "mode")
    assert len(marks) == 1 + MAX_FRAMES


def test_the_truth_has_a_colour_of_its_own(scene, tmp_path):
    estimate = CASES["OK"]
    truth = estimate.trajectory.copy()
    truth[:, 1, 3] += 0.5
    without = pixels(write_plan(scene, estimate, tmp_path / "a.png", width=800))
    with_truth = pixels(write_plan(scene, estimate, tmp_path / "b.png", truth=truth, width=800))
    assert share(without, "transit") == 0
    assert share(with_truth, "transit") > 200


def test_a_wide_camera_sees_more(scene, tmp_path):
    seen = []
    for focal in (1000.0, 200.0):
        camera = Camera(640, 480, focal, focal, 320.0, 240.0)
        path = write_plan(scene, CASES["no history"], tmp_path / "a.png", camera=camera, width=600)
        red, green, _ = np.moveaxis(pixels(path)[HEAD:-FOOT].astype(int), -1, 0)
        seen.append(int((red - green > 25).sum()))
    assert seen[1] > 2 * seen[0]


def test_witnesses_are_things(plan):
    assert evidence_rows(plan, BEST) == [(5, "for"), (6, "against")], "walls are everywhere"
    stranger = mode(0, 0, 0, 1.0, evidence=refs((99, "for", 3.0), (5, "silent", 1.0)))
    assert evidence_rows(plan, stranger) == []


def test_an_animation_ends_with_the_result_and_needs_a_history(scene, tmp_path):
    path = write_plan_animation(scene, CASES["OK"], tmp_path / "plan.gif", width=400)
    assert path.stat().st_size < 2_000_000
    with Image.open(path) as image:
        assert image.format == "GIF"
        assert image.info["loop"] == 0
        assert image.n_frames == 3 * 4 + 1
        durations = []
        for k in range(image.n_frames):
            image.seek(k)
            durations.append(image.info["duration"])
        last = np.asarray(image.convert("RGB"))
    assert durations[-1] > 5 * durations[0]
    assert share(last, "mode", 24) > 60
    with pytest.raises(OptionError, match="record=True"):
        write_plan_animation(scene, CASES["no history"], tmp_path / "no.gif")
    assert not (tmp_path / "no.gif").exists()


@pytest.mark.parametrize("write", [write_plan, write_plan_animation])
def test_widths_out_of_range_are_refused(write, scene, tmp_path):
    for width in (0, 319, 6001, 800.0):
        with pytest.raises(OptionError, match="320 to 6000"):
            write(scene, CASES["OK"], tmp_path / "plan.png", width=width)
    assert not (tmp_path / "plan.png").exists()


def test_a_scene_alone(scene, tmp_path):
    image = pixels(draw_scene(scene, tmp_path / "room.png", width=700))
    assert image.shape[1] == 700
    wall = np.array(light("wall"))
    assert (np.abs(image.astype(int) - wall).max(axis=-1) < 3).sum() > 1000


@given(st.floats(1, 60), st.floats(1, 60), st.lists(st.integers(0, 30), max_size=7))
def test_panels_do_not_overlap(wide, deep, steps):
    layout = Layout.of((0.0, 0.0, wide, deep), steps)
    assert layout.columns <= max(steps, default=0)
    assert all(steps[k] for k in layout.rows)
    left, top = layout.large_corner
    assert left + layout.large[0] == layout.width
    assert top + layout.large[1] + FOOT == layout.height
    cells = {
        layout.corner(row, column)
        for row in range(len(layout.rows))
        for column in range(layout.columns)
    }
    assert len(cells) == len(layout.rows) * layout.columns
    for x, y in cells:
        assert y - CAPTION >= HEAD
        right, bottom = x + layout.small[0], y + layout.small[1]
        assert right <= layout.width
        assert bottom <= layout.height - FOOT
        assert right <= left or bottom <= top


BARE = {
    "floor": ((0, 0, -0.1), (6, 4, 0)),
    "wall west": ((-0.2, 0, 0), (0, 4, 2.6)),
    "wall north": ((0, 4, 0), (6, 4.2, 2.6)),
    "unknown 1": ((4, 2, 0), (5, 3, 0.9)),
    "unknown 2": ((1, 3, 0), (2, 4, 0.9)),
}
"""A corner of a room whose things have no names."""
FLOOR_COLOUR, BOX_COLOURS = (150, 120, 90), ((30, 60, 220), (210, 40, 30))


@pytest.fixture(scope="module")
def bare():
    mesh, colours = scene_of(BARE).mesh, np.full((40, 3), 200, np.uint8)
    colours[:8], colours[24:32], colours[32:] = FLOOR_COLOUR, *BOX_COLOURS
    coloured = Mesh.plain(mesh.vertices, mesh.triangles, mesh.object_of, colours)
    labels = [label.split()[0] for label in BARE]
    return SceneMap.create(coloured, [str(k) for k in range(5)], labels, floor=0.0, scene="room")


def test_things_without_names_show_their_colours_and_no_words(bare):
    plan = RoomPlan(bare)
    assert plan.is_bare.tolist() == [True, False, False, True, True]
    frame = Frame.around(plan.bounds, 420, 280)
    picture = paint_room(plan, frame)
    for at, colour in (((4.5, 2.5), BOX_COLOURS[0]), ((1.5, 3.5), BOX_COLOURS[1])):
        drawn = pixel(picture, frame, at)
        assert np.argmax(drawn) == np.argmax(colour), "red is red, blue is blue"
        assert max(drawn) - min(drawn) > 70
    assert not near(pixel(picture, frame, (3.0, 1.0)), light("floor"), 20)
    assert plan.names(frame, choose_face(["unknown"]), OccupiedPlaces(), {3: "for"}) == []
    chair = RoomPlan(scene_of({**BARE, "chair": ((3, 1, 0), (3.5, 1.5, 0.9))}))
    assert not chair.is_bare[0], "a floor among things with names has the paint of floors"


def test_evidence_ends_amid_what_is_seen_in_its_colour(bare):
    plan = RoomPlan(bare)
    box = evidence_marks(plan, mode(1, 1, 0.5, 0.9, evidence=refs((3, "for", 2.0))), 1.0)[-1]
    assert isinstance(box, Disc)
    assert box.rim == "for"
    assert 4 <= box.at[0] <= 5
    assert 2 <= box.at[1] <= 3
    assert ImageColor.getrgb(box.color) == BOX_COLOURS[0]
    point, _ = plan.point_in_view(2, np.array([1.0, 1.0, 1.6, 1.2]), 0.6)
    assert 0.5 < point[0] < 3.5, "the part of a long wall that is in view, not its middle"


CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)


def shown_at(scene, pose, *, depth=True):
    """Return a frame that shows a scene from a pose (4, 4)."""
    drawn = scene.render(pose, CAMERA, samples=1)
    read = np.where(drawn.mask, drawn.depth, np.nan).astype(np.float32) if depth else None
    return SimpleNamespace(
        index=10, camera=CAMERA, depth_camera=CAMERA if depth else None,
        has_colour=True, rgb=lambda: drawn.colour, depth=lambda: read,
    )  # fmt: skip


@pytest.mark.parametrize("depth", [True, False])
def test_a_wrong_place_looks_wrong(bare, depth):
    down = level_from_camera((0.0, np.cos(0.3), np.sin(0.3)))
    right, wrong = (pose_matrix((x, 0.5, 1.6, 1.2), down) for x in (2.0, 3.5))
    frame = shown_at(bare, right, depth=depth)
    verdicts = [dot.color for dot in mark_agreement(bare, 0.0, frame, right)]
    assert len(verdicts) > 100
    assert verdicts.count("against") < 0.03 * len(verdicts)
    verdicts = [dot.color for dot in mark_agreement(bare, 0.0, frame, wrong)]
    assert verdicts.count("against") > 0.15 * len(verdicts)
    frame.has_colour, frame.rgb = False, None  # a frame of depth alone
    assert len(mark_agreement(bare, 0.0, frame, right)) == pytest.approx(len(verdicts), rel=0.5)


def test_frames_are_compared_with_the_map_where_they_are_given(bare, tmp_path):
    pose = pose_matrix((2.0, 0.5, 1.6, 1.2), level_from_camera((0.0, np.cos(0.3), np.sin(0.3))))
    best = replace(mode(2.0, 0.5, 1.2, 0.9), map_from_camera=pose)
    estimate = replace(estimate_of(Status.OK, best, steps=1), trajectory=pose[None])
    without = pixels(write_plan(bare, estimate, tmp_path / "a.png"))
    frames = [shown_at(bare, pose)]
    shown = pixels(write_plan(bare, estimate, tmp_path / "b.png", capture=frames))
    assert share(without[HEAD:], "for") == 0
    assert share(shown[HEAD:], "for") > 500
    stranger = SimpleNamespace(index=99)
    again = pixels(write_plan(bare, estimate, tmp_path / "c.png", capture=[stranger]))
    np.testing.assert_array_equal(again, without)


def test_a_crack_in_a_wall_lets_no_look_through():
    walls = {
        "floor": ((0, 0, -0.1), (6, 6, 0)),
        "wall a": ((0, 3, 0), (2.98, 3.2, 2.6)),
        "wall b": ((3.02, 3, 0), (6, 3.2, 2.6)),
    }
    ring = view_ring(RoomPlan(scene_of(walls)), np.array([3.0, 1.0, 1.5, np.pi / 2]), 1.0, 3.5)
    assert ring[:, 1].max() < 3.05


def test_one_frame_leaves_no_panel_blank():
    layout = Layout.of((0.0, 0.0, 4.0, 4.0), [1])
    assert layout.columns == 1
    assert layout.large_corner == (layout.small[0] + GAP, HEAD)
    assert layout.large[1] == layout.small[1] + CAPTION
