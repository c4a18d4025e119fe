import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor import encode
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.encode import MapEncoder, Patches, bind_encoder
from placegraph.indoor.encode.labels import (
    GRID,
    ClassesOfInstances,
    Confusion,
    InstancesEncoder,
    LabelsEncoder,
    explain_foreign_ids,
)
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.io.capture.frame import Frame

CAMERA = Camera(160, 90, 100.0, 100.0, 80.0, 45.0)
EIGHT = Camera(80, 40, 50.0, 50.0, 40.0, 20.0)
UNIT = ((0, 0, 0), (1, 1, 1))
FOUR = (4, 8)


@pytest.fixture(scope="module")
def scene(boxes):
    model = boxes({"floor": UNIT, "Chair": UNIT, "desk": UNIT, "chair ": UNIT, "object": UNIT})
    return scene_of_model(model)


def frame(names, row, kind="labels", camera=EIGHT):
    ids = np.asarray(row)
    if ids.ndim == 1:
        ids = np.kron(np.array([row] * 4), np.ones((10, 10), int))
    return Frame.from_arrays(
        np.zeros((90, 160, 3), np.uint8), CAMERA, labels=ids, label_camera=camera, label_kind=kind,
        label_names=names,
    )  # fmt: skip


def cosines(encoder, scene, image):
    patches = bind_encoder(encoder, scene).encode(image)
    rows = patches.rows[:8]
    return np.where(rows[:, None] >= 0, patches.table[rows], np.nan)


def test_labels_are_all_objects_of_that_label(scene):
    names = {3: "chair", 4: "DESK", 5: "floor", 6: "unknown", 9: " chairs"}
    image = frame(names, [3, 4, 5, 6, -1, 7, 9, 3])
    got = cosines(LabelsEncoder(FOUR), scene, image)
    assert got[[0, 6, 7]][:, [1, 3]] == pytest.approx(1, abs=1e-5)
    assert got[1, 2] == pytest.approx(1, abs=1e-5)
    assert got[2, 0] == pytest.approx(1, abs=1e-5)
    assert np.isnan(got[[3, 4, 5]]).all()
    assert np.abs(got[[0, 1, 2]][[[0], [1], [2]], [[0, 2], [0, 1], [1, 2]]]).max() < 0.3
    assert not got[0, 4]  # nothing is known of that one
    merged = merge_scenes({"attic": scene, "cellar": scene})
    both = cosines(LabelsEncoder(FOUR), merged, image)
    assert np.flatnonzero(both[0] > 0.99).tolist() == [1, 3, 6, 8]
    patches = bind_encoder(LabelsEncoder(FOUR), scene).encode(image)
    assert (patches.camera, patches.grid) == (EIGHT, FOUR)
    assert len(patches.table) == 3  # patches of one label share a row
    assert patches.temperature == LabelsEncoder.temperature


def test_other_words_mean_the_same_or_what_is_alike(scene):
    names = {0: "armchair", 1: "office chair", 2: "table", 3: "parquet", 4: "refrigerator"}
    got = cosines(LabelsEncoder(FOUR), scene, frame(names, [0, 1, 2, 3, 4, 4, 4, 4]))
    assert got[:4].argmax(axis=1).tolist() == [1, 1, 2, 0]
    assert (got[:4].max(axis=1) > 0.6).all()
    assert got[4].max() < 0.3


def test_a_grid_is_any(scene):
    image = frame({0: "chair", 2: "desk"}, [0, 0, 0, 0, 2, 2, 2, 2])
    for grid in (GRID, (14, 14), (3, 2)):
        encoder = LabelsEncoder(grid)
        got = encoder.patches(image)
        assert got.shape == (*grid, encoder.dimension)
        assert (got[0, 0] == encoder.vector("chair")).all()
        assert (got[-1, -1] == encoder.vector("desk")).all()
    assert (
        LabelsEncoder((1, 1)).patches(image)[0, 0] @ LabelsEncoder().objects(scene).T > 0.99
    ).any()


def test_frames_that_say_nothing(scene):
    bare = Frame.from_arrays(np.zeros((90, 160, 3), np.uint8), CAMERA)
    assert LabelsEncoder().camera(bare) == CAMERA
    assert LabelsEncoder().patches(bare) is None
    assert bind_encoder(LabelsEncoder(), scene).encode(frame({0: "unknown"}, [0] * 8)) is None
    image = frame({}, [0, 1, 2, 3, 4, 5, 6, 7], "instances")
    assert LabelsEncoder().patches(image) is None
    with pytest.raises(OptionError, match="object ids without names"):
        bind_encoder(LabelsEncoder(), scene).encode(image)
    named = frame({3: "chair"}, [3] * 8, "instances")
    assert (LabelsEncoder().patches(named) @ LabelsEncoder().vector("chair") > 0.99).all()


def test_vectors_that_the_map_holds_are_used(scene):
    encoder = LabelsEncoder(FOUR)
    held = scene.with_embeddings(encoder.objects(scene)[::-1], encoder=encoder.key)
    got = cosines(encoder, held, frame({0: "chair"}, [0] * 8))
    assert np.flatnonzero(got[0] > 0.95).tolist() == [1, 3]  # reversed, they are the same rows
    got = cosines(encoder, held, frame({0: "floor"}, [0] * 8))
    assert np.flatnonzero(got[0] > 0.95).tolist() == [4]


def probable(**share):
    values = np.array(list(share.values()), np.float32)
    return {
        "segmenter": lambda image: np.broadcast_to(values, (12, 24, len(values))),  # noqa: ARG005
        "names": list(share),
    }


def test_probabilities_are_mixtures(scene):
    image = frame({}, [0] * 8)
    encoder = LabelsEncoder(FOUR, **probable(chair=0.5, desk=0.5))
    assert encoder.camera(image) == CAMERA  # it reads the colour image
    got = cosines(encoder, scene, image)
    assert got[0, 1] == pytest.approx(got[0, 2], abs=1e-3)
    assert got[0, 1] > got[0, 0] + 0.4
    sure = cosines(LabelsEncoder(FOUR, **probable(chair=1.0, desk=0.0)), scene, image)
    assert sure[0, 1] == pytest.approx(1, abs=1e-5)
    mostly = cosines(LabelsEncoder(FOUR, **probable(chair=0.8, desk=0.2)), scene, image)
    assert 1 > mostly[0, 1] > got[0, 1] > mostly[0, 2] > mostly[0, 0]


def test_probabilities_are_averaged_over_patches(scene):
    shares = np.zeros((6, 12, 2))
    shares[:, :6, 0] = shares[:, 6:, 1] = 1.0
    encoder = LabelsEncoder((1, 3), segmenter=lambda _: shares, names=["chair", "desk"])
    got = encoder.patches(frame({}, [0] * 8))[0] @ encoder.objects(scene).T
    assert got[0, 1] == pytest.approx(1, abs=1e-5)
    assert got[2, 2] == pytest.approx(1, abs=1e-5)
    assert got[1, 1] == pytest.approx(got[1, 2], abs=1e-3)


class Halves:
    names = {7: "sofa"}  # noqa: RUF012

    def size(self, width, height):
        return width, height

    def labels(self, rgb):
        out = np.full(rgb.shape[:2], -1)
        out[:, : out.shape[1] // 2] = 7
        return out


def test_a_segmenter_of_colour_images():
    encoder = LabelsEncoder(FOUR, segmenter=Halves())
    image = frame({0: "chair"}, [0] * 8)
    got = encoder.patches(image)
    assert (got[:, :4] == encoder.vector("couch")).all()
    assert not got[:, 4:].any()
    assert encoder.camera(image) == CAMERA


def test_segmenters_that_do_not_keep_their_word():
    image = frame({}, [0] * 8)
    for answer in (
        np.ones((4, 4)), np.ones((4, 4, 3)), np.ones((4, 4, 2), int), np.full((4, 4, 2), np.nan),
        np.full((4, 4, 2), -0.5),
    ):  # fmt: skip
        encoder = LabelsEncoder(segmenter=lambda _, a=answer: a, names=["chair", "desk"])
        with pytest.raises(OptionError, match="segmenter"):
            encoder.patches(image)

    class Broken(Halves):
        def labels(self, rgb):
            return np.zeros(rgb.shape)

    with pytest.raises(OptionError, match=r"labels \(height, width\)"):
        LabelsEncoder(segmenter=Broken()).patches(image)


def test_options_that_are_none(scene):
    for grid in ((0, 4), (4, 0), (-1, 2)):
        for make in (LabelsEncoder, lambda grid: InstancesEncoder(scene, grid)):
            with pytest.raises(OptionError, match="at least one row"):
                make(grid)
    with pytest.raises(OptionError, match="names: they are missing; list"):
        LabelsEncoder(segmenter=lambda _: np.ones((1, 1, 1)))
    for options in ({"names": ["chair"]}, {"names": ["chair"], "segmenter": Halves()}):
        with pytest.raises(OptionError, match="names: they apply only"):
            LabelsEncoder(**options)
    with pytest.raises(OptionError, match="encoder 'labels'"):
        encode.encoder("labels", shape=3)


def test_a_said_label_stands_for_what_it_may_be(scene):
    known = Confusion(
        ("table", "desk", "floor"), [[0.1, 0.0, 0.9], [0.4, 0.6, 0.0], [0.0, 0.9, 0.1]]
    )
    names = {0: "table", 1: "desk", 2: "chair"}
    image = frame(names, [0, 1, 2, 2, 2, 2, 2, 2])
    plain = cosines(LabelsEncoder(FOUR), scene, image)
    told = cosines(LabelsEncoder(FOUR, confusion=known), scene, image)
    assert told[0, 2] > plain[0, 2] + 0.05
    assert told[1, 0] > told[1, 2] > 0.3 > plain[1, 0]
    assert (told[2] == plain[2]).all()  # nothing is known of chairs
    assert np.linalg.norm(LabelsEncoder(confusion=known).patches(image), axis=2) == pytest.approx(
        1, abs=1e-5
    )
    assert LabelsEncoder(confusion=known).key == LabelsEncoder().key
    swapped = Confusion(("desk", "chair"), [[0.0, 1.0], [1.0, 0.0]])
    encoder = LabelsEncoder(FOUR, confusion=swapped, **probable(chair=1.0, desk=0.0))
    assert cosines(encoder, scene, image)[0].argmax() == 2


INSTANCES = frame(None, [0, 1, 2, 3, -1, 7, 1, 1], "instances")


def objects_of(patches):
    agreed = [set(np.flatnonzero(row == 1).tolist()) for row in patches.table]
    return [agreed[r] if r >= 0 else None for r in patches.rows[:8]]


def test_instances_are_single_objects(scene):
    encoder = InstancesEncoder(scene, FOUR)
    assert isinstance(encoder, MapEncoder)
    patches = encoder.encode(INSTANCES)
    assert isinstance(patches, Patches)
    assert objects_of(patches) == [{0}, {1}, {2}, {3}, None, None, {1}, {1}]
    assert (patches.rows.reshape(4, 8) == patches.rows[:8]).all()
    assert (patches.camera, patches.grid) == (EIGHT, FOUR)
    assert (patches.rows.dtype, patches.table.dtype) == (np.int32, np.float32)
    assert set(np.unique(patches.table)) == {-1, 1}
    bare = Frame.from_arrays(np.zeros((90, 160, 3), np.uint8), CAMERA)
    for other in (bare, frame({0: "chair"}, [0] * 8)):  # ids of labels are no ids of objects
        assert InstancesEncoder(scene).encode(other) is None


def test_instances_read_as_labels(scene, boxes):
    patches = ClassesOfInstances(scene, FOUR).encode(INSTANCES)
    assert objects_of(patches) == [{0}, {1, 3}, {2}, {1, 3}, None, None, {1, 3}, {1, 3}]
    assert len(patches.table) == 4  # one row a label
    other = scene_of_model(boxes({"desk": UNIT, "desk ": UNIT, "chair": UNIT}))
    merged = merge_scenes({"attic": scene, "cellar": other})  # rows 0 to 4, and 5 to 7
    got = objects_of(InstancesEncoder(merged, FOUR).encode(INSTANCES))
    assert got[:6] == [{0, 5}, {1, 6}, {2, 7}, {3}, None, None]
    got = objects_of(ClassesOfInstances(merged, FOUR).encode(INSTANCES))
    assert got[:4] == [{0, 5, 6}, {1, 3, 5, 6}, {2, 7}, {1, 3}]


@pytest.mark.parametrize(
    ("counts", "winner"),
    [
        ({1: 900, 2: 700}, 1), ({1: 700, 2: 900}, 2),
        ({1: 500, 2: 400, 3: 600}, 3),  # the most, if less than half
        ({1: 800}, 1), ({1: 799}, -1),  # half is known, or less
        ({1: 300, 2: 200, 3: 400}, 3),  # more than half is known, of whatever
        ({}, -1),
    ],
)  # fmt: skip
def test_the_majority_of_pixels_speaks(scene, counts, winner):
    ids = np.repeat([*counts, -1], [*counts.values(), 1600 - sum(counts.values())])
    image = np.hstack([ids.reshape(40, 40), np.full((40, 40), -1)])
    rows = InstancesEncoder(scene, (1, 2)).encode(frame(None, image, "instances")).rows
    assert rows.tolist() == [winner, -1]


def test_ids_of_another_map_are_told(scene):
    own = frame(None, [0, 1, 2, 3, -1, -1, 1, 1], "instances")
    other = frame(None, [0, 10, 12, 13, 14, -1, 1, 1], "instances")
    assert not explain_foreign_ids(scene, [own], 0.9)
    said = explain_foreign_ids(scene, [own, other], 0.9)
    assert "Of the 8 instance ids in the frames, 4 are unknown in this map (10, 12" in said
    assert "labels=None" in said
    assert "may belong to another map" in explain_foreign_ids(
        scene, [own], 0.1
    )  # numbers are alike everywhere
    assert not explain_foreign_ids(scene, [frame({1: "a"}, [1] * 8)], 0.1)
