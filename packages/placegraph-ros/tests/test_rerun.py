import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.io.capture.frame import Frame
from placegraph_ros.pose_messages import estimate_messages, rig_message
from placegraph_ros.rerun import RerunWriter
from placegraph_ros.scene_messages import image_messages, map_messages

pytest.importorskip("rerun", reason="needs the extra rerun, 163 MB")


def columns(path):
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if ":" in name:
                key = (str(chunk.entity_path), name.rpartition(":")[2])
                found.setdefault(key, []).extend(
                    row for row in batch.column(name).to_pylist() if row is not None
                )
    return found


def test_everything_is_in_the_recording(tmp_path, estimate, scene):
    camera = Camera(8, 6, 8.0, 8.0, 4.0, 3.0)
    frame = Frame.from_arrays(np.full((6, 8, 3), 90, np.uint8), camera, stamp=0.0)
    known = estimate()
    with RerunWriter(tmp_path / "out.rrd") as file:
        for message in [*map_messages(scene, 2.0), rig_message(None, 2.0)]:
            file.write(message)
        for stamp, said in ((2.5, known), (2.75, known), (3.0, estimate(Status.LOST))):
            for message in image_messages(frame, stamp) + estimate_messages(said, stamp):
                file.write(message)
        assert not (tmp_path / "out.rrd").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["out.rrd"]
    found = columns(tmp_path / "out.rrd")
    place = found["/map/base", "translation"]
    base = known.best.map_from_camera[:3, 3]
    np.testing.assert_allclose(place, [[base], [base]], rtol=1e-6)
    drawn = np.reshape(found["/map/map/lamp/1", "vertex_positions"], (-1, 3))
    np.testing.assert_allclose(drawn, scene.mesh.vertices[scene.mesh.triangles[1]], atol=1e-6)
    assert found["/map/objects/for/names", "labels"][0] == ["table +3.5"]
    assert len(found["/map/particle_cloud", "positions"][0]) == 24
    assert len(found["/map/path", "strips"][0]) == 1
    assert found["/status", "text"][-1] == ["LOST: One place fits."]
    assert "lamp 2" in found["/evidence", "text"][0][0]
    assert bytes(found["/camera/image", "blob"][0][0])[:2] == b"\xff\xd8"
    assert found["/map/base", "is_recursive"] == [[True]]  # lost: no pose is shown


def test_a_recording_that_failed_is_not_there(tmp_path):
    with pytest.raises(ZeroDivisionError), RerunWriter(tmp_path / "out.rrd"):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out.rrd").write_text("mine")
    with pytest.raises(OptionError, match="already exists"):
        RerunWriter(tmp_path / "out.rrd")
