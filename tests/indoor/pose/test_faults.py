"""Bad input is named, and never `OK`; what is only unusual is not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.errors import InputError, OptionError
from placegraph.indoor import localize
from placegraph.indoor.likelihood.observe import Observation
from placegraph.indoor.pose import agreement as faults
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.indoor import perturb as bad
from placegraph_lab.tables.indoor.perturb import Clip, Recording, height

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def clip(walk, room, truth):
    """Ten frames in the room, with depth and colours alone."""
    recording = Recording("walk", walk.frames, truth(walk), 0.2, lambda: room)
    return bad.only(Clip.of(recording, range(10)), ("depth", "colour"))


def half_elsewhere(clip, _, rng):  # noqa: ARG001
    """The first frames are from the same walk seen in a mirror: no place of this room."""
    frames = bad.mirror_images(clip, 0, None).frames[:5] + clip.frames[5:]
    return replace(clip, frames=frames)


@pytest.mark.parametrize(
    ("spoil", "strength", "said"),
    [
        (bad.lens_cap, 0, "lens seems to be covered"),
        (bad.freeze_images, 0, "frames 0 to 9 are identical"),
        (bad.mirror_images, 0, "seem to be mirrored"),
        (bad.gravity_up, 0, "Gravity seems to point up"),
        (half_elsewhere, 0, "contradict the others"),
    ],
)
def test_what_is_wrong_is_named(room, clip, rng, spoil, strength, said):
    estimate = room.localize(spoil(clip, strength, rng).frames, refine=False)
    assert estimate.status is not Status.OK
    assert said in estimate.reason
    assert estimate.reason.endswith(".")


def test_a_camera_outside_the_rooms_is_nowhere(room, clip, rng):
    assert room.localize(height(clip, 3.2, rng).frames, refine=False).status is not Status.OK


def test_time_that_runs_backwards_is_refused(room, walk, clip, tmp_path):
    with pytest.raises(OptionError, match=r"frames: .* increase"):
        room.localize(bad.backwards(clip, 0, None).frames)
    folder = tmp_path / "walk"
    folder.mkdir()
    for part in walk.path.iterdir():
        (folder / part.name).symlink_to(part)
    rows = (walk.path / "odometry.tum").read_text().splitlines()
    first = next(i for i, row in enumerate(rows) if not row.startswith("#"))
    (folder / "odometry.tum").unlink()
    rows[first], rows[first + 1] = rows[first + 1], rows[first]
    (folder / "odometry.tum").write_text("\n".join(rows))
    with pytest.raises(InputError, match=rf"odometry\.tum, line {first + 2}: the stamp .* earlier"):
        open_capture(folder)


def test_plain_frames_are_above_suspicion(room, clip):
    assert room.localize(clip.frames, refine=False).status is Status.OK
    last = clip.frames[-1]
    still = [replace(last, stamp=last.stamp + i) for i in range(4)]
    assert "frozen" not in room.localize(still, refine=False).reason
    twice = list(clip.frames)
    twice[4] = replace(twice[4], images=twice[3].images)
    assert "frozen" not in room.localize(twice, refine=False).reason


def test_a_place_elsewhere_is_lost_without_a_fault(room, clip):
    """Depth that fits nothing: no fault taken back mends it, and none is named."""
    rng = np.random.default_rng(4)
    frames = [
        bad.with_images(f, rgb=rng.integers(0, 255, f.rgb().shape, np.uint8),
                 depth=rng.uniform(0.5, 6, f.depth().shape))
        for f in clip.frames
    ]  # fmt: skip
    estimate = room.localize(frames, refine=False)
    assert estimate.status is Status.LOST
    assert estimate.reason.startswith("No place on the map fits")


def test_hopeless_frames_are_not_searched(room, clip, rng, monkeypatch):
    monkeypatch.setattr(localize, "search", None)
    estimate = room.localize(bad.lens_cap(clip, 0, rng).frames)
    assert estimate.status is Status.LOST
    assert not estimate.modes
    assert estimate.to_dict()["status"] == "LOST"


@pytest.mark.parametrize(
    ("colours", "said"),
    [
        ([0.0] * 5 + [0.06] * 5, True), ([0.06] * 9 + [0.001], True), ([0.06] * 9 + [0.021], False),
        ([0.06] * 4 + [0.0] + [0.06] * 5, False), ([0.0] * 10, False),
    ],
)  # fmt: skip
def test_images_alone_can_contradict_each_other(colours, said, clip):
    observations = [Observation(f, np.eye(3), None, None, f.rgb()) for f in clip.frames]
    window = SimpleNamespace(observations=observations)
    frames = np.column_stack([np.full((10, 2), np.nan), colours])
    assert bool(faults.find_contradiction(window, frames)) is said
