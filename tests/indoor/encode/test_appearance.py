from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.indoor.encode import bind_encoder
from placegraph.indoor.encode.appearance import (
    DIMENSION,
    MIN_GLANCES,
    AppearanceEncoder,
    aim_poses,
    spread_poses,
)
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.textures import linear_from_srgb, srgb_from_linear
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.render import Renderer
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Frame

APPEARANCE = AppearanceEncoder()


def frame_of(rgb):
    h, w = rgb.shape[:2]
    return Frame.from_arrays(rgb, Camera(w, h, w, w, w / 2, h / 2))


def lit(rgb, gains):
    linear = linear_from_srgb(rgb / 255.0) * gains
    return np.rint(255 * np.clip(srgb_from_linear(linear), 0, 1)).astype(np.uint8)


@pytest.fixture(scope="module")
def vectors(room):
    return APPEARANCE.objects(room)


@pytest.fixture(scope="module")
def pictures(walk):
    return [f.rgb() for f in walk]


@pytest.mark.parametrize(
    ("shape", "grid"),
    [((160, 90), (16, 9)), ((91, 161), (9, 16)), ((2, 1), (16, 9)), ((3, 5000), (9, 16))],
)
def test_images_of_any_size_have_patches(shape, grid, rng):
    image = frame_of(rng.integers(0, 256, (*shape, 3), np.uint8))
    patches = APPEARANCE.patches(image)
    assert patches.shape == (*grid, DIMENSION)
    assert patches.dtype == np.float32
    assert np.linalg.norm(patches, axis=-1) == pytest.approx(1.0, abs=1e-4)
    assert APPEARANCE.camera(image) is image.camera


@given(st.tuples(*[st.integers(0, 255)] * 3), st.sampled_from([(1, 1), (36, 64), (300, 200)]))
def test_an_image_of_one_colour_says_nothing(colour, shape):
    patches = APPEARANCE.patches(frame_of(np.full((*shape, 3), colour, np.uint8)))
    assert patches.shape == (*((16, 9) if shape[0] > shape[1] else (9, 16)), DIMENSION)
    assert not patches.any()


def test_patches_lie_where_the_image_has_them():
    rgb = np.full((144, 256, 3), 200, np.uint8)
    rgb[32:48, 64:80] = 180, 20, 30
    patches = APPEARANCE.patches(frame_of(rgb))
    assert np.linalg.norm(patches, axis=-1) == pytest.approx(1, abs=1e-4)  # even ones speak, too
    odd = patches @ patches[0, 0] < 0.9
    assert odd[2, 4]
    assert odd.sum() == 1


def test_an_upright_image_is_read_upright(pictures):
    rgb = pictures[0]
    turned = APPEARANCE.patches(frame_of(np.ascontiguousarray(np.rot90(rgb))))
    lying = APPEARANCE.patches(frame_of(rgb))
    assert np.sum(np.rot90(lying) * turned, axis=-1).min() > 0.9


@pytest.mark.parametrize("gains", [(1.4, 1.4, 1.4), (0.7, 0.7, 0.7), (0.8, 0.95, 1.1)])
def test_exposure_and_white_balance_change_little(pictures, gains):
    same, other = [], []
    for rgb in pictures:
        before, after = (
            APPEARANCE.patches(frame_of(image)).reshape(-1, DIMENSION)
            for image in (rgb, lit(rgb, gains))
        )
        cosines = after @ before.T
        same.append(np.diag(cosines).mean())
        other.append(np.median(cosines))
    assert np.mean(same) > 0.8
    assert np.mean(same) > np.mean(other) + 0.4


def test_every_object_that_can_be_seen_has_a_unit_vector(room, vectors, walk):
    assert vectors.shape == (len(room), DIMENSION)
    lengths = np.linalg.norm(vectors, axis=1)
    assert np.isclose(lengths, 1.0, atol=1e-4).sum() >= len(room) - 1
    assert (np.isclose(lengths, 1.0, atol=1e-4) | (lengths == 0.0)).all()
    assert APPEARANCE.objects(room, [walk]) == pytest.approx(vectors)
    mesh = Mesh.plain(room.mesh.vertices, room.mesh.triangles, room.mesh.object_of)
    bare = SceneMap.create(mesh, room.graph.ids, room.graph.labels, floor=0.0)
    assert not APPEARANCE.objects(bare).any()


def test_patches_know_their_objects(room, vectors, walk):
    ranks = []
    for frame in walk:
        ids = np.asarray(Image.fromarray(frame.labels()).resize((16, 9), Image.Resampling.NEAREST))
        cosines = APPEARANCE.patches(frame) @ vectors.T
        for id_, row in zip(ids.ravel().tolist(), cosines.reshape(144, -1), strict=True):
            if id_ >= 0:
                ranks.append((row < row[room.row_of(str(id_))]).mean())
    assert np.mean(ranks) > 0.8


def test_bound_to_a_map(room, vectors, walk):
    kept = room.with_embeddings(vectors, encoder=APPEARANCE.key)
    patches = bind_encoder(APPEARANCE, kept).encode(walk[0])
    assert patches.grid == (9, 16)
    assert patches.temperature == APPEARANCE.temperature
    table = APPEARANCE.patches(walk[0]).reshape(144, -1) @ vectors.T
    assert patches.table[patches.rows] == pytest.approx(table, abs=0.03)  # 8 bits


CAMERA = Camera(64, 36, 46.0, 46.0, 32.0, 18.0)


@pytest.fixture(scope="module")
def table(room):
    return room.visibility(PoseSearchOptions())


def test_glances_are_spread_over_free_places(table):
    poses = spread_poses(table)
    assert len(poses) >= MIN_GLANCES
    assert np.linalg.det(poses[:, :3, :3]) == pytest.approx(1.0)
    at = poses[:, :3, 3]
    nearest = np.linalg.norm(at[:, None] - table.positions[None], axis=2).min(axis=1)
    assert nearest == pytest.approx(0.0)
    assert np.ptp(at[:, :2], axis=0) == pytest.approx(np.ptp(table.positions[:, :2], axis=0))
    assert (poses[:, 2, 1] < 0).all()  # upright: the image's down is down
    headings = np.arctan2(poses[:, 1, 2], poses[:, 0, 2])
    assert len(np.unique(np.floor(headings / (np.pi / 4)) % 8)) == 8


def test_an_object_asked_for_is_looked_at(room, table):
    renderer = Renderer(room)
    visible = np.unique(table.panoramas.objects)
    visible = visible[visible < len(room)]
    poses = aim_poses(table, visible)
    assert len(poses) == len(visible)
    seen = [
        (renderer.render(pose, CAMERA, samples=1).objects == row).sum() >= 4
        for row, pose in zip(visible.tolist(), poses, strict=True)
    ]
    assert sum(seen) >= len(seen) - 1  # one may stand behind the edge of another
    assert aim_poses(table, np.array([len(room) + 7])).shape == (0, 4, 4)
    assert spread_poses(replace(table, positions=np.zeros((0, 3)))).shape == (0, 4, 4)
