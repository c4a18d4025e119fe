"""The live tracker: odometry and images as they come, and files of where it was."""

from concurrent.futures import Executor, Future
from dataclasses import replace
from threading import Thread
from time import sleep

import numpy as np
import pytest
from tests.indoor.conftest import rebuild_frame

from placegraph.core.estimate import Status
from placegraph.core.geometry import Camera
from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import InputError, MapError, OptionError
from placegraph.indoor.options import FilterOptions, PoseSearchOptions
from placegraph.indoor.track.belief import AHEAD, JUMP, KEPT, Odometry
from placegraph.indoor.track.live import KIND, VERSION, LiveTracker, SavedPose
from placegraph.indoor.track.tracker import Relocalizer
from placegraph.io.capture.frame import ArrayImages, Frame

pytestmark = pytest.mark.usefixtures("one_thread")


class ManualExecutor(Executor):
    """Runs jobs when it is asked to."""

    def __init__(self):
        self.jobs = []

    def submit(self, fn, /, *args, **kwargs):
        self.jobs.append(lambda: fn(*args, **kwargs))
        return Future()

    def run(self):
        """Do the newest job."""
        self.jobs.pop()()

    def run_all(self):
        while self.jobs:
            self.run()


def distance(pose, truth):
    return np.linalg.norm(pose.map_from_camera[:3, 3] - truth[:3, 3])


def check_found(pose, truth, metres=0.2):
    assert pose.status is Status.OK
    assert distance(pose, truth) < metres


def drive(live, frames):
    """Pose after odometry and images of frames."""
    for frame in frames:
        live.move(frame.stamp, frame.odometry)
        pose = live.step(frame)
    return pose


def blind(frame):
    """The same moment, without anything to compare: for options of depth alone."""
    return Frame.from_arrays(
        frame.rgb(), frame.camera, gravity=frame.gravity, odometry=frame.odometry, stamp=frame.stamp
    )


@pytest.fixture(scope="module")
def wheels(film):
    """Odometry of the film at any time."""
    odometry = Odometry()
    for frame in film:
        odometry.tell(frame.stamp, frame.odometry)
    return lambda stamp: odometry.at(stamp).pose


@pytest.fixture
def live(room, film):
    """Follows in the caller's thread."""
    return room.live(film.camera, background=False)


def found(live, film, count=6):
    for frame in film[:count]:
        pose = live.step(frame)
    assert pose.status is Status.OK
    return pose


def test_images_at_five_and_odometry_at_fifty_hertz(live, film, wheels, truth):
    true, off = truth(film), []
    for i, frame in enumerate(film[:20]):
        # frames carry no odometry that could be used: it is another frame
        live.move(frame.stamp, wheels(frame.stamp))
        live.see(replace(frame, odometry=np.eye(4)))
        for stamp in frame.stamp + np.arange(1, 10) * 0.02:
            pose = live.move(stamp, wheels(stamp))
            assert pose.stamp == pytest.approx(stamp)
            if pose.status is Status.OK:
                share = (stamp - frame.stamp) / 0.2
                between = (1 - share) * true[i, :3, 3] + share * true[i + 1, :3, 3]
                off.append(np.linalg.norm(pose.map_from_camera[:3, 3] - between))
                assert 0 < pose.age < 0.2
                np.testing.assert_allclose(
                    pose.map_from_odom @ wheels(stamp), pose.map_from_camera, atol=1e-9
                )
    assert len(off) > 120
    assert np.median(off) < 0.08
    assert max(off) < 0.5
    assert live.dropped == live.late == 0


def test_a_late_image_counts_from_its_own_time(room, film, wheels):
    anchors = []
    for late in (0.0, 0.37, 3.0):
        live = room.live(film.camera, background=False)
        for frame in film[:5]:
            for stamp in frame.stamp + np.arange(-9, 1) * 0.02:
                live.move(stamp, wheels(max(stamp, 0.0)))
            if frame is film[4]:
                for stamp in np.arange(0.05, late + 0.01, 0.05):
                    live.move(frame.stamp + stamp, wheels(frame.stamp + stamp))
            pose = live.step(frame)
        assert pose.status is Status.OK
        anchors.append(pose.map_from_odom)
        ahead = live.pose()
        assert ahead.age == pytest.approx(late, abs=0.06)
        assert np.trace(ahead.covariance) >= np.trace(pose.covariance) - 1e-12
    np.testing.assert_allclose(anchors[1:], anchors[:1] * 2, atol=1e-9)


def test_the_newest_image_is_looked_at_and_the_pose_goes_on_meanwhile(room, film):
    executor = ManualExecutor()
    live = room.live(film.camera, background=executor)
    for frame in film[:4]:
        live.move(frame.stamp, frame.odometry)
        live.see(frame)
        executor.run_all()
    before = live.pose()
    assert before.status is Status.OK
    for frame in film[4:8]:
        live.move(frame.stamp, frame.odometry)
        live.see(frame)
    assert live.dropped == 3
    assert len(executor.jobs) == 1
    assert live.pose().estimate is before.estimate
    np.testing.assert_allclose(live.pose().map_from_camera, before.map_from_odom @ film[7].odometry)
    executor.run_all()
    assert live.pose().estimate.frames[-1] == film[7].index
    assert live.pose().age == 0.0


def test_a_lost_camera_is_looked_up_beside_images(room, film, elsewhere, truth):
    executor = ManualExecutor()
    live = room.live(film.camera, background=executor)
    for frame in film[:6]:
        live.see(frame)
        executor.run_all()
    assert live.pose().status is Status.OK
    bridge = film[5].odometry @ np.linalg.inv(elsewhere[0].odometry)
    stati = []
    for i, frame in enumerate(elsewhere[:6]):
        live.see(replace(frame, odometry=bridge @ frame.odometry, stamp=10.0 + i))
        executor.run()  # the image, beside what is being looked up
        stati.append(live.pose().status)
        if i == 2:
            assert stati == [Status.LOST] * 3
            assert len(executor.jobs) == 1  # one question at a time
            executor.run_all()
            # of its first frame, two seconds ago, and carried on by odometry since
            assert live.pose().status is Status.AMBIGUOUS
            assert distance(live.pose(), truth(elsewhere)[i]) < 0.3
        if i == 4:
            executor.run_all()
            assert live.pose().status is Status.OK
    assert stati[3:] == [Status.AMBIGUOUS, Status.AMBIGUOUS, Status.OK]
    assert distance(live.pose(), truth(elsewhere)[5]) < 0.15


def test_frames_that_show_nothing_are_carried_on(room, film, truth):
    live = room.live(film.camera, background=False, options=PoseSearchOptions().only(depth=True))
    lost = live.step(blind(film[0]))
    assert (lost.status, lost.map_from_camera) == (Status.LOST, None)
    assert "cannot be compared" in lost.reason
    known = found(live, film[1:8], 7)

    class Torn:
        def rgb(self):
            raise InputError("rgb/000009.jpg is broken.")

        depth = labels = rgb

    nothing = live.step(blind(film[8]))
    assert "cannot be compared" in nothing.reason
    torn = live.step(replace(film[9], images=Torn()))
    assert "000009.jpg" in torn.reason
    for pose, row in ((nothing, 8), (torn, 9)):
        check_found(pose, truth(film)[row])
        assert pose.age > 0
    assert np.trace(torn.covariance) > np.trace(nothing.covariance) > np.trace(known.covariance)
    assert live.step(film[10]).age == 0.0


def test_images_with_and_without_depth(room, film, truth):
    live = room.live(
        film.camera, background=False, options=PoseSearchOptions().only(depth=True, colour=True)
    )
    poses = [live.step(blind(f) if i % 2 else f) for i, f in enumerate(film[:16])]
    assert [p.status for p in poses[6:]].count(Status.OK) >= 8
    for pose, true in zip(poses, truth(film), strict=False):
        assert pose.status is not Status.OK or distance(pose, true) < 0.5


@pytest.mark.parametrize("back", [4.0, 1e9])
def test_a_clock_that_was_set_back(back, live, film, truth):
    assert drive(live, film[:8]).status is Status.OK
    pose = live.move(film[8].stamp - back, film[8].odometry)
    assert pose.status is Status.AMBIGUOUS
    assert "clock" in pose.reason
    assert distance(pose, truth(film)[8]) < 0.2  # odometry went on all the same
    after = live.step(replace(film[8], stamp=film[8].stamp - back))
    check_found(after, truth(film)[8])


def test_samples_a_little_late_are_left_out(live, wheels):
    live.move(1.0, wheels(1.0))
    live.move(0.9, wheels(0.9))
    assert live.late == 1
    assert live.pose().stamp == 1.0


def test_odometry_that_begins_anew(live, film, truth):
    found(live, film, 8)
    anew = np.linalg.inv(film[8].odometry)
    anew[:3, 3] += 5.0
    pose = live.step(replace(film[8], odometry=anew @ film[8].odometry))
    check_found(pose, truth(film)[8])
    broken = live.move(film[8].stamp + 0.1, np.eye(4))
    assert broken.status is Status.AMBIGUOUS
    assert "arrived in addition to that of the" in broken.reason


def test_images_of_another_clock(live, film):
    live.move(100.0, np.eye(4))
    live.see(replace(film[0], stamp=100.0 + 2 * AHEAD))
    assert "ahead of odometry" in live.pose().reason
    live.see(replace(film[0], stamp=100.0 - 2 * KEPT))
    assert "older than all odometry" in live.pose().reason
    assert live.dropped == 2


@pytest.mark.parametrize(
    ("off", "height"), [((0.2, -0.15, 0.0), 0.01), ((0.2, 0.1, -1.5), 1.0)], ids=["pose", "plan"]
)
def test_somebody_says_where_it_is(room, film, truth, off, height):
    true = truth(film)
    loose = np.diag([0.09, 0.09, height, 0.0, 0.0, 0.04])
    live = room.live(film.camera, background=False)
    placed = true[0].copy()
    placed[:3, 3] += off
    live.place(placed, loose)
    assert live.pose().map_from_camera is None  # nobody knows odometry yet
    live.move(0.0, film[0].odometry)
    before = live.pose()
    assert (before.status, before.scene) == (Status.AMBIGUOUS, room.scenes[0])
    np.testing.assert_allclose(before.map_from_camera, placed)
    after = live.step(film[0])
    check_found(after, true[0], 0.15)

    wrong = true[0].copy()
    wrong[:2, 3] += (1.8, 1.0)
    live.place(wrong, 0.01 * loose)
    for frame, pose in zip(film[1:8], true[1:8], strict=True):
        live.move(frame.stamp, frame.odometry)
        now = live.step(frame)
        assert now.status is not Status.OK or distance(now, pose) < 0.3
    assert now.status is Status.OK


def zoom(image, camera, factor):
    """Return the image (h, w, ...) and the camera of `factor` times the focal length."""
    new = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = np.moveaxis(camera.project(new.directions(np.stack([u, v], -1))), -1, 0).astype(int)
    return image[y, x], new


def refocus(frame, factor):
    """Return the frame of a lens with `factor` times the focal length."""
    rgb, camera = zoom(frame.rgb(), frame.camera, factor)
    depth, depth_camera = zoom(frame.depth(), frame.depth_camera, factor)
    images, kinds = ArrayImages(rgb, depth, None), {"label_camera": None, "label_kind": None}
    return replace(frame, camera=camera, depth_camera=depth_camera, images=images, **kinds)


def test_a_phone_that_refocuses(live, room, film, truth):
    zooms = [refocus(f, z) for f, z in zip(film[:8], np.linspace(1.0, 1.1, 8), strict=True)]
    for frame in zooms:
        last = live.step(frame)
    check_found(last, truth(film)[7], 0.1)
    tracker = room.tracker(film.camera, seed=0)
    for frame in zooms:
        estimate = tracker.update(frame)
    assert estimate.status is Status.OK
    assert distance(estimate.best, truth(film)[7]) < 0.1


def test_to_lose_a_pose(live, film):
    found(live, film)
    live.lose()
    assert live.pose().status is Status.LOST
    assert live.pose().map_from_odom is None
    assert drive(live, film[6:10]).status is Status.OK


def test_what_is_refused(live, room, film):
    live.see(film[0])
    other = Camera(160, 90, 150.0, 150.0, 80.0, 45.0)
    for ask, says in (
        (lambda: live.see(replace(film[1], camera=other)), "camera differs"),
        (lambda: live.place(np.zeros((4, 4)), np.eye(6)), "map_from_camera"),
        (lambda: live.place(np.eye(4), np.full((6, 6), np.inf)), "covariance"),
        (lambda: live.place(np.eye(4), np.eye(6), "no such room"), "no such room"),
        (lambda: room.live(options=FilterOptions.paper()), "start='table'"),
    ):
        with pytest.raises(OptionError, match=says):
            ask()
    live.close()
    with pytest.raises(OptionError, match="closed"):
        live.see(film[2])


def test_what_breaks_in_the_background_is_told(room, film, monkeypatch):
    executor = ManualExecutor()
    live = room.live(film.camera, background=executor)
    monkeypatch.setattr(live._tracker, "follow", lambda _: 1 / 0)
    live.see(film[0])
    executor.run_all()
    with pytest.raises(ZeroDivisionError):
        live.pose()


def test_threads(room, film, truth):
    with room.live(film.camera) as live:
        pose = drive(live, film[:6])
        check_found(pose, truth(film)[5])
        assert live.dropped == 0
        assert live.status_counts.total() == 6


def test_who_waits_is_told_that_it_was_closed(room, film):
    live, told = room.live(film.camera, background=ManualExecutor()), []
    live.see(film[0])

    def waits():
        with pytest.raises(OptionError, match="closed"):
            live.wait()
        told.append(True)

    waiting = Thread(target=waits, daemon=True)
    waiting.start()
    while not live._changed._waiters:  # until it waits
        sleep(0.001)
    live.close()
    waiting.join(10)
    assert told


@pytest.mark.parametrize("seen", [False, True])
def test_odometry_that_falls_silent(seen, live, film):
    drive(live, film[:6])
    frame = film[5]
    assert live.pose(frame.stamp + JUMP).status is Status.OK
    later = frame.stamp + 3.0
    if seen:
        live.see(replace(film[6], stamp=later))
    pose = live.pose(later)
    assert pose.status is Status.AMBIGUOUS
    assert "There was no odometry for 3 s" in pose.reason
    assert live.move(later, frame.odometry).status is Status.OK


def test_an_alias_that_one_image_fits_is_not_believed(live, film, truth, monkeypatch):
    whole, search = Relocalizer.anywhere, []

    def fooled(relocalizer, frames, rng):
        name, told = whole(relocalizer, frames, rng)
        search.append(told.status)
        if len(search) > 1:
            return name, told
        pose = truth(film)[0].copy()
        pose[2, 3] += 0.7
        return name, replace(
            told, status=Status.OK, modes=(replace(told.best, map_from_camera=pose),)
        )

    monkeypatch.setattr(Relocalizer, "anywhere", fooled)
    poses = [live.step(frame) for frame in film[:8]]
    assert poses[0].status is Status.AMBIGUOUS
    assert "another image must confirm it" in poses[0].reason
    sure = [(p, t) for p, t in zip(poses, truth(film), strict=False) if p.status is Status.OK]
    assert len(sure) >= 3
    assert all(distance(pose, true) < 0.2 for pose, true in sure)


@pytest.mark.parametrize("count", [1, 2])
def test_of_several_places_none_is_the_pose(count, live, film, monkeypatch):
    whole = Relocalizer.anywhere

    def doubted(relocalizer, frames, rng):
        name, told = whole(relocalizer, frames, rng)
        return name, replace(told, status=Status.AMBIGUOUS, modes=told.modes[:1] * count)

    monkeypatch.setattr(Relocalizer, "anywhere", doubted)
    pose = live.step(film[0])
    assert pose.status is Status.AMBIGUOUS
    assert (pose.map_from_camera is None) == (count > 1)
    assert len(pose.estimate.modes) == count


def test_depth_in_another_unit_is_named(live, film):
    pose = live.step(rebuild_frame(film[0], depth=film[0].depth() / 1000))
    assert pose.status is Status.LOST
    assert "metres" in pose.reason


def test_slow_frames_are_looked_up_with_those_before(room, film):
    search = []
    live = room.live(film.camera, background=False, options=PoseSearchOptions().only(colour=True))
    live._tracker.take_answer = lambda found: search.append(found.frames)
    for i in range(24):
        odometry = film[0].odometry.copy()
        odometry[:3, 3] += (0.04 * i, 0.0, 0.0)
        live.step(replace(film[0], odometry=odometry, stamp=0.2 * i))
    last = [frame.odometry[0, 3] for frame in search[-1]]
    assert len(last) > 5
    assert np.all(np.diff(last) > 0.1)


@pytest.fixture(scope="module")
def saved(room, film, tmp_path_factory):
    """File of a tracker that knew where it was at the sixth frame, and its pose."""
    live = room.live(film.camera, background=False)
    pose = drive(live, film[:6])
    path = tmp_path_factory.mktemp("saved") / "robot.track"
    live.save(path)
    return path, pose


def test_a_saved_pose_and_odometry_that_goes_on(saved, room, film, truth):
    path, pose = saved
    live = LiveTracker.load(path, room, background=False)
    loaded = live.pose()
    assert loaded.status is Status.AMBIGUOUS
    for name in ("map_from_camera", "map_from_odom", "covariance"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(pose, name))
    moved = live.move(film[8].stamp, film[8].odometry)
    np.testing.assert_allclose(moved.map_from_odom, pose.map_from_odom)
    after = live.step(film[8])
    check_found(after, truth(film)[8])


def test_a_saved_pose_and_odometry_that_begins_anew(saved, room, film, truth):
    live = LiveTracker.load(saved[0], room, background=False)
    first, after = live.move(0.0, np.eye(4)), live.step(replace(film[5], stamp=0.0))
    assert (first.status, after.status) == (Status.AMBIGUOUS, Status.OK)
    for pose in (first, after):
        assert distance(pose, truth(film)[5]) < 0.2


def test_what_cannot_be_saved_or_loaded(saved, room, flat, tmp_path):
    path, _ = saved
    with pytest.raises(OptionError, match="no pose to save"):
        room.live(background=False).save(tmp_path / "a.track")
    with pytest.raises(InputError, match="does not exist"):
        LiveTracker.load(tmp_path / "a.track", room)
    with pytest.raises(MapError, match="another map"):
        LiveTracker.load(path, flat)
    room.save(tmp_path / "room.scene")
    with pytest.raises(MapError, match="scene map"):
        LiveTracker.load(tmp_path / "room.scene", room)
    for cut in (0, 7, 100, 400):
        (tmp_path / "cut.track").write_bytes(path.read_bytes()[:cut])
        with pytest.raises((MapError, InputError)):
            LiveTracker.load(tmp_path / "cut.track", room)
    assert path.stat().st_size < 5000


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("map_from_camera", np.zeros((4, 4))), ("map_from_camera", np.eye(3)),
        ("odom_from_camera", np.full((4, 4), np.nan)), ("covariance", -np.eye(6)),
        ("stamp", np.array([np.inf])), ("stamp", np.zeros(0)), ("covariance", None), ("scene", 3),
        ("digest", None),
    ],
)  # fmt: skip
def test_columns_that_are_none(saved, tmp_path, name, value):
    file = read_map(saved[0], KIND, VERSION)
    meta, arrays = dict(file.meta), dict(file.arrays)
    if name in meta:
        meta[name] = value
    elif value is None:
        del arrays[name]
    else:
        arrays[name] = value
    write_map(tmp_path / "a.track", KIND, VERSION, meta, arrays)
    with pytest.raises(MapError, match=r"a\.track"):
        SavedPose.read(tmp_path / "a.track")
