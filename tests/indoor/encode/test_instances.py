"""Encoders of captures whose labels are ids of the map's objects."""

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.encode import MapEncoder, Patches
from placegraph.indoor.encode.grid import GRID
from placegraph.indoor.encode.instances import ClassesOfInstances, InstancesEncoder, foreign
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.io.capture.frame import Frame

CAMERA = Camera(160, 90, 100.0, 100.0, 80.0, 45.0)
UNIT = ((0, 0, 0), (1, 1, 1))


@pytest.fixture(scope="module")
def scene(boxes):
    """Four objects, ids 0 to 3; two of them are chairs, if written differently."""
    model = boxes({"floor": UNIT, "Chair": UNIT, "desk": UNIT, "chair ": UNIT})
    return scene_of_model(model)


def frame(ids, kind="instances", names=None, camera=None):
    return Frame.from_arrays(
        np.zeros((90, 160, 3), np.uint8), CAMERA, labels=np.array(ids, np.int32),
        label_kind=kind, label_names=names, label_camera=camera,
    )  # fmt: skip


def blocks(rows, size=10):
    """Label image whose patches each have one value."""
    return np.kron(np.array(rows), np.ones((size, size), int))


EIGHT = Camera(80, 40, 50.0, 50.0, 40.0, 20.0)  # blocks of 4 x 8 patches of 10 px


def words_of(patches):
    """What each patch agrees with: sets of objects, None where it says nothing."""
    agreed = [set(np.flatnonzero(row == 1).tolist()) for row in patches.table]
    return [agreed[r] if r >= 0 else None for r in patches.rows]


def test_instances_are_single_objects(scene):
    image = blocks([[0, 1, 2, 3, -1, 7, 1, 1]] * 4)
    encoder = InstancesEncoder(scene, (4, 8))
    assert isinstance(encoder, MapEncoder)
    patches = encoder.encode(frame(image, camera=EIGHT))
    assert isinstance(patches, Patches)
    assert words_of(patches)[:8] == [{0}, {1}, {2}, {3}, None, None, {1}, {1}]
    assert words_of(patches)[8:16] == words_of(patches)[:8]
    assert (patches.camera, patches.grid) == (EIGHT, (4, 8))
    assert patches.rows.dtype == np.int32
    assert patches.table.dtype == np.float32
    assert set(np.unique(patches.table)) == {-1, 1}


def test_instances_read_as_labels(scene):
    image = blocks([[0, 1, 2, 3, -1, 9, 0, 0]] * 4)
    patches = ClassesOfInstances(scene, (4, 8)).encode(frame(image, camera=EIGHT))
    assert words_of(patches)[:8] == [{0}, {1, 3}, {2}, {1, 3}, None, None, {0}, {0}]
    assert len(patches.table) == 3  # one row a label


def test_the_majority_of_pixels_speaks(scene):
    image = np.full((40, 80), -1)
    encoder = InstancesEncoder(scene, (1, 2))

    def left(**share):
        """Column 0 of two patches of 1600 pixels: so many of each object."""
        flat = np.full(1600, -1)
        first = 0
        for name, count in share.items():
            flat[first : first + count] = int(name[1:])
            first += count
        image[:, :40] = flat.reshape(40, 40)
        return int(encoder.encode(frame(image, camera=EIGHT)).rows[0])

    assert left(o1=900, o2=700) == 1
    assert left(o1=700, o2=900) == 2
    assert left(o1=500, o2=400, o3=600) == 3  # the most, if less than half
    assert left(o1=800) == 1  # half is known
    assert left(o1=799) == -1  # less than half
    assert left(o1=300, o2=200, o3=400) == 3  # more than half is known, of whatever
    assert left() == -1
    assert int(encoder.encode(frame(image, camera=EIGHT)).rows[1]) == -1


@pytest.mark.parametrize("shape", [(45, 80), (90, 160), (31, 53), (9, 16)])
@pytest.mark.parametrize("grid", [GRID, (14, 14), (4, 3), (1, 1)])
def test_any_image_has_the_encoders_grid(scene, shape, grid):
    """Patches of 196 or 144 or any number; those that no pixel lies in say nothing."""
    image = np.zeros(shape, int)
    image[:, shape[1] // 2 :] = 2
    camera = CAMERA.resized(shape[1], shape[0])
    patches = InstancesEncoder(scene, grid).encode(frame(image, camera=camera))
    rows = patches.rows.reshape(grid)
    pixel_rows = {y * grid[0] // shape[0] for y in range(shape[0])}
    for y in range(grid[0]):
        if y not in pixel_rows:
            assert (rows[y] == -1).all()
        elif grid[1] > 1:
            assert rows[y, 0] == 0
            assert rows[y, -1] == 2


def test_frames_without_such_labels(scene):
    image = blocks([[0] * 8] * 4)
    bare = Frame.from_arrays(np.zeros((90, 160, 3), np.uint8), CAMERA)
    assert InstancesEncoder(scene).encode(bare) is None
    # ids of labels are no ids of objects
    labelled = frame(image, "labels", {0: "chair"}, EIGHT)
    assert InstancesEncoder(scene).encode(labelled) is None


def test_numbers_in_a_merged_map_are_of_any_scene(scene):
    merged = merge_scenes({"attic": scene, "cellar": scene})
    image = blocks([[0, 1, 2, 3, -1, 9, 0, 0]] * 4)
    got = words_of(InstancesEncoder(merged, (4, 8)).encode(frame(image, camera=EIGHT)))
    assert got[:6] == [{0, 4}, {1, 5}, {2, 6}, {3, 7}, None, None]
    got = words_of(ClassesOfInstances(merged, (4, 8)).encode(frame(image, camera=EIGHT)))
    assert got[:4] == [{0, 4}, {1, 3, 5, 7}, {2, 6}, {1, 3, 5, 7}]


def test_a_number_may_be_a_chair_here_and_a_desk_there(scene, boxes):
    other = scene_of_model(boxes({"desk": UNIT, "desk ": UNIT, "chair": UNIT}))
    merged = merge_scenes({"attic": scene, "cellar": other})  # rows 0 to 3, and 4 to 6
    image = blocks([[0, 1, 2, 3, -1, 9, 0, 0]] * 4)
    got = words_of(ClassesOfInstances(merged, (4, 8)).encode(frame(image, camera=EIGHT)))
    assert got[:4] == [{0, 4, 5}, {1, 3, 4, 5}, {2, 6}, {1, 3}]


def test_encoders_that_are_none(scene):
    for grid in ((0, 4), (4, 0), (-1, 2)):
        with pytest.raises(OptionError, match="at least one row"):
            InstancesEncoder(scene, grid)


def test_the_rendered_walk_says_what_is_there(room, walk):
    """Nearly all patches of a rendered frame see an object that the map has."""
    patches = InstancesEncoder(room).encode(walk[0])
    assert patches.grid == GRID
    assert (patches.rows >= 0).mean() > 0.95
    assert len(np.unique(patches.rows)) > 3


def test_ids_of_another_map_are_told(scene):
    own, other = (
        frame(blocks([[0, 1, 2, 3, -1, -1, 1, 1]] * 4), camera=EIGHT),
        frame(blocks([[0, 10, 12, 13, 14, -1, 1, 1]] * 4), camera=EIGHT),
    )
    assert not foreign(scene, [own], 0.9)
    said = foreign(scene, [own, other], 0.9)
    assert "Of the 8 instance ids in the frames, 4 are no objects of this map (10, 12" in said
    assert "labels=None" in said
    assert "may be another map's" in foreign(scene, [own], 0.1)  # numbers are alike everywhere
    assert not foreign(scene, [frame(blocks([[1] * 8] * 4), "labels", {1: "a"}, EIGHT)], 0.1)
