"""What is sent to other processes: small, without what was derived, and the same there."""

import pickle

import numpy as np
import pytest

import placegraph as pg
from placegraph.core.estimate import Evidence, Explained, Place, Status
from placegraph.core.geometry import Camera
from placegraph.io.capture.capture import Frame

SAID = "A bakery is north of me. The church is east of the bakery."


def sent(thing):
    return pickle.loads(pickle.dumps(thing))  # noqa: S301  # our own


@pytest.fixture(scope="module")
def flat(demo_world):
    return pg.open_map(demo_world / "altbau.scene")


@pytest.fixture(scope="module")
def walk(demo_world):
    return pg.open_capture(demo_world / "walk")


def test_evidence_travels_and_what_found_it_does_not():
    evidence = (Evidence("chair 17", "for", 3.5),)
    here = Place(9.0, 53.0, 1.0, "c0r0", np.eye(2), explain=lambda: evidence)
    there = sent(here)
    assert there.evidence == there.explain() == evidence
    assert isinstance(there, Explained)


def test_a_city_and_what_was_found_in_it(harbour):
    estimate = harbour.locate(SAID)
    there = sent(harbour)
    assert len(pickle.dumps(harbour)) < 50_000  # tables of the search are made again
    assert there.fingerprint == harbour.fingerprint
    assert there.locate(SAID).to_dict() == estimate.to_dict()
    assert len(pickle.dumps(estimate)) < 100_000
    assert sent(estimate).to_dict() == estimate.to_dict()
    assert estimate.map is harbour
    assert sent(estimate).map is None


def test_a_scene_a_capture_and_a_pose(flat, walk):
    frames = slice(0, 3)
    estimate = flat.localize(walk, frames=frames)
    there, clip = sent(flat), sent(walk)
    assert len(pickle.dumps(flat)) < 1_000_000
    assert len(pickle.dumps(walk)) < 20_000
    np.testing.assert_array_equal(clip[0].depth(), walk[0].depth())
    again = there.localize(clip, frames=frames)
    np.testing.assert_array_equal(again.best.pose, estimate.best.pose)
    assert len(pickle.dumps(estimate)) < 50_000
    assert sent(estimate).to_dict() == estimate.to_dict()


def test_arrays_that_nobody_may_write_stay_so(flat, harbour):
    """Compiled code is of either kind; it must not be compiled twice."""
    for here, there in ((flat, sent(flat)), (harbour, sent(harbour))):
        pairs = [(here, there)]
        while pairs:
            a, b = pairs.pop()
            names = getattr(type(a), "__dataclass_fields__", ())
            for one, other in ((getattr(a, n), getattr(b, n)) for n in names):
                if isinstance(one, np.ndarray):
                    assert one.flags.writeable == other.flags.writeable
                    np.testing.assert_array_equal(one, other)
                pairs.append((one, other))


def test_a_library_takes_along_the_maps_that_no_file_holds(demo_world, flat):
    library = pg.SceneLibrary("labels")
    library.add("file", demo_world / "home1.scene")
    library.add("memory", flat)
    library.search("a kitchen")
    there = sent(library)
    assert there.names == ("file", "memory")
    assert len(there.scene("memory")) == len(flat)
    assert there.search("a kitchen").best.scene == library.search("a kitchen").best.scene


def test_frames_in_memory():
    camera = Camera(4, 3, 4.0, 4.0, 2.0, 1.5)
    frame = Frame.from_arrays(np.zeros((3, 4, 3), np.uint8), camera, depth=np.ones((3, 4)))
    there = sent(frame)
    assert there.depth().tolist() == frame.depth().tolist()
    assert not there.gravity.flags.writeable


def test_short_in_a_shell(harbour, flat, walk):
    shown = [repr(harbour.locate(SAID)), repr(flat.localize(walk, frames=slice(0, 2)))]
    assert max(map(len, shown)) < 400
    assert Status.AMBIGUOUS.value in shown[0]
    assert "PoseMode" in shown[1]
