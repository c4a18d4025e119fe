"""A tiny world in the published layout of KITTI360Pose, pickled under the published names."""

import pickle
import sys
import types
from contextlib import contextmanager
from itertools import accumulate

import numpy as np

PACKAGE = "datapreparation.kitti360pose.imports"
NAMES = ("Cell", "Object3d", "Pose", "DescriptionBestCell", "DescriptionPoseCell")
DRIVES = ("0000", "0003", "0005", "0009", "0010")
SIZE, STRIDE = 30.0, 10.0
STUFF = {"road": (110, 113, 104), "sidewalk": (136, 137, 126), "vegetation": (67, 70, 60)}
THINGS = ["pole", "traffic sign", "lamp", "trash bin", "box", "garage", "smallpole", "stop"]
PAINTS = [(47, 50, 42), (87, 92, 80), (214, 216, 207), (27, 28, 25), (171, 170, 155)]
COLOURS = {
    (47, 50, 42): "dark-green", (136, 137, 126): "gray", (110, 113, 104): "gray",
    (87, 92, 80): "gray-green", (214, 216, 207): "bright-gray", (27, 28, 25): "black",
    (67, 70, 60): "green", (171, 170, 155): "beige",
}  # fmt: skip


@contextmanager
def published(package=PACKAGE, names=NAMES):
    """Module with stand-ins for the published classes, as long as something is pickled."""
    parts = package.split(".")
    modules = {name: types.ModuleType(name) for name in accumulate(parts, "{}.{}".format)}
    for name in names:
        modules[package].__dict__[name] = type(name, (), {"__module__": package})
    sys.modules.update(modules)
    try:
        yield modules[package]
    finally:
        for name in modules:
            del sys.modules[name]


def made(cls, **fields):
    instance = cls()
    instance.__dict__.update(fields)
    return instance


def colour(rgb):
    mean = 255.0 * rgb.mean(axis=0)
    return COLOURS[min(COLOURS, key=lambda c: ((np.array(c) - mean) ** 2).sum())]


def street(rng):
    """Things of one drive: instance, label, points (n, 3), colours (n, 3); some 80 m along x."""
    east = np.arange(-20.0, 100.0, 0.8)
    things = []

    def add(label, points, paint):
        points = np.asarray(points, np.float64)
        height = rng.random((len(points), 1))
        rgb = np.clip(np.array(paint) / 255.0 + 0.004 * rng.standard_normal((len(points), 3)), 0, 1)
        xyz = np.hstack([points, height])
        things.append((1000 + len(things), label, xyz, rgb.astype(np.float32)))

    for label, north in (("road", np.arange(-3.0, 3.1, 1.0)), ("sidewalk", np.array([4.0, 5.0]))):
        add(label, np.stack(np.meshgrid(east, north), -1).reshape(-1, 2), STUFF[label])
    for start in rng.uniform(-20.0, 90.0, 4):
        strip = np.arange(start, start + 8.0, 0.7)
        add("vegetation", np.stack([strip, np.full(len(strip), -6.5)], 1), STUFF["vegetation"])
    for _ in range(45):
        at = np.array([rng.uniform(-20.0, 100.0), rng.choice([-1, 1]) * rng.uniform(4.0, 13.0)])
        paint = PAINTS[rng.integers(len(PAINTS))]
        add(rng.choice(THINGS), at + 0.2 * rng.standard_normal((8, 2)), paint)
    return things


def cell_objects(module, things, low):
    """Objects of the box at `low`, as the published preparation cuts them out."""
    objects = []
    for instance, label, xyz, rgb in things:
        inside = ((xyz >= low) & (xyz <= low + SIZE)).all(axis=1)
        if label in STUFF:
            if inside.sum() < 6:
                continue
            xyz, rgb = xyz[inside], rgb[inside]  # noqa: PLW2901
        elif inside.mean() < 1 / 3:
            continue
        fields = {"instance_id": np.int32(instance), "xyz": (xyz - low) / SIZE, "rgb": rgb}
        objects.append(made(module.Object3d, id=len(objects), **fields, label=str(label)))
    return objects


def direction(offset):
    if np.hypot(*offset) < 0.05:
        return "on-top"
    if abs(offset[0]) >= abs(offset[1]):
        return "east" if offset[0] >= 0 else "west"
    return "north" if offset[1] >= 0 else "south"


def describe(module, things, cell, pose):
    """Descriptions of a pose by its six closest objects, grounded in its best cell."""
    low = pose - SIZE / 2
    at = (pose - low) / SIZE
    told = []
    for thing in cell_objects(module, things, low):
        nearest = thing.xyz[np.argmin(np.linalg.norm(thing.xyz - at, axis=1))]
        told.append((np.linalg.norm(nearest - at), thing.id, thing, nearest))
    hints = []
    for _, _, thing, nearest in sorted(told, key=lambda t: t[:2])[:6]:
        match = [o for o in cell.objects if o.instance_id == thing.instance_id]
        fields = {
            "object_instance_id": thing.instance_id,
            "object_label": thing.label,
            "object_color_rgb": thing.rgb.mean(axis=0),
            "object_color_text": colour(thing.rgb),
            "direction": direction((at - nearest)[:2]),
            "offset_center": (at - thing.xyz.mean(axis=0))[:2],
            "offset_closest": (at - nearest)[:2],
            "closest_point": nearest[:2],
            "is_matched": bool(match),
        }
        if match:
            fields["object_id"] = match[0].id
        hints.append(made(module.DescriptionBestCell, **fields))
    return hints


def drive_of(module, drive, rng, n_cells=8, n_poses=2):
    """Cells and poses of a drive."""
    things = street(rng)
    origin = np.array([1000.0, 4000.0 + 200.0 * int(drive), 100.0])
    things = [(i, label, xyz + origin, rgb) for i, label, xyz, rgb in things]
    cells = []
    for k in range(n_cells):
        low = origin + np.array([STRIDE * k, 0.0, 0.0]) - SIZE / 2
        fields = {"cell_size": np.float64(SIZE), "bbox_w": np.hstack([low, low + SIZE])}
        objects = cell_objects(module, things, low)
        cell = made(module.Cell, scene_name=drive, id=f"{drive}_{k:05d}", objects=objects, **fields)
        cells.append(cell)
    poses = []
    for cell in cells * n_poses:
        shift = np.append(rng.uniform(-4.5, 4.5, 2), 0.0)
        pose = 0.5 * (cell.bbox_w[:3] + cell.bbox_w[3:]) + shift
        fields = {"pose": (pose - cell.bbox_w[:3]) / SIZE, "pose_w": pose, "cell_id": cell.id}
        fields["descriptions"] = describe(module, things, cell, pose)
        poses.append(made(module.Pose, **fields, scene_name=drive, described_by="closest"))
    return cells, poses


POINTS = {
    "b": "amenity=bench", "w": "amenity=waste_basket", "l": "highway=street_lamp",
    "p": "amenity=post_box", "h": "emergency=fire_hydrant", "t": "natural=tree",
    "B": "shop=bakery name=Kern", "K": "amenity=kiosk name=Am Eck",
}  # fmt: skip
SQUARE_M = 5.0


def karlsruhe(world, drives=DRIVES, seed=0):
    """A town in ASCII where the drives are: a street each, with things on both sides.

    `world` converts KITTI-360's frame; to be parsed by `Town.parse`.
    """
    rng = np.random.default_rng(seed)
    low, high = (4000.0 + 200.0 * int(d) for d in (min(drives), max(drives)))
    rows, columns = int((high - low) / SQUARE_M) + 9, 28
    page = [[" "] * columns for _ in range(rows)]
    for drive in drives:
        middle = rows - 5 - int((200.0 * int(drive) - low + 4000.0) / SQUARE_M)
        for row in range(middle - 3, middle + 4):
            for column in range(columns):
                if row == middle:
                    page[row][column] = "-"
                elif rng.random() < 0.5:
                    page[row][column] = rng.choice(list(POINTS))
        page[middle][10] = "1"
    center = world.to_lonlat((1040.0, 0.5 * (low + high)))
    drawing = "\n".join("".join(line).rstrip() or "." for line in page)
    legend = "\n".join(f"{glyph}: {tags}" for glyph, tags in POINTS.items())
    return (
        f"[town]\nname = Karlsruhe\ncenter = {center[0]:.7f} {center[1]:.7f}\n"
        f"metres = {SQUARE_M}\n[drawing]\n{drawing}\n[legend]\n{legend}\n"
        "1 road: highway=residential name=Gartenweg\n"
    )


def write_set(folder, *, drives=DRIVES, protocol=4, seed=0, n_cells=8, edit=None):
    """Write a folder in the published layout; `edit(module, cells, poses)` may spoil a drive."""
    for kind in ("cells", "poses"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    with published() as module:
        for drive in drives:
            rng = np.random.default_rng([seed, int(drive)])
            cells, poses = drive_of(module, drive, rng, n_cells)
            if edit is not None:
                edit(module, cells, poses)
            name = f"2013_05_28_drive_{drive}_sync.pkl"
            (folder / "cells" / name).write_bytes(pickle.dumps(cells, protocol=protocol))
            (folder / "poses" / name).write_bytes(pickle.dumps(poses, protocol=protocol))
    return folder
