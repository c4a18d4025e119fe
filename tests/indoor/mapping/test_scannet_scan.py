import numpy as np
import pytest

from placegraph.indoor.build import scene_of_model
from placegraph.io.capture.capture import open_capture
from placegraph_io.dataset.scannet import axis_alignment, read_scannet


@pytest.fixture(scope="module")
def scan(scannet_world, room_world, walk, truth, tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans") / scannet_world.NAME
    found = scannet_world.Scan(folder, scannet_world.ObjectMesh(room_world.scene))
    recording = scannet_world.Recording.of(walk, scannet_world.SCAN_FROM_MAP @ truth(walk))
    recording.write_sens(found.file(".sens"))
    return found


def test_the_map_of_a_scan_is_the_room(scan, room):
    scene = scene_of_model(read_scannet(scan.folder))
    assert scene.graph.labels == room.graph.labels
    np.testing.assert_allclose(scene.graph.positions, room.graph.positions, atol=2e-3)
    assert scene.floors[0] == pytest.approx(room.floors[0], abs=2e-3)


def test_the_recording_sees_the_map_where_it_is(scan, walk):
    scene = scene_of_model(read_scannet(scan.folder))
    capture = open_capture(scan.folder)
    assert capture.camera == walk.camera
    assert capture.depth_camera == walk.depth_camera
    map_from_camera = axis_alignment(scan.folder) @ capture.odometry
    errors = []
    for frame, pose in zip(capture, map_from_camera, strict=True):
        depth = frame.depth()
        v, u = np.nonzero(np.isfinite(depth))
        rays = frame.depth_camera.directions(np.stack([u, v], axis=-1) + 0.5) @ pose[:3, :3].T
        hits = scene.caster.cast(np.broadcast_to(pose[:3, 3], rays.shape), rays)
        errors.append(np.abs(hits.distance - depth[v, u])[hits.triangle >= 0])
        assert len(errors[-1]) > 0.99 * len(rays)
    assert np.median(np.concatenate(errors)) < 0.02  # the sensor's own noise
