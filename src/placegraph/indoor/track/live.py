"""Live tracker: odometry and images from any thread, one pose at any time, saved in a small file."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from threading import Condition
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.geometry import Floats
from placegraph.core.mapfile import read_map, write_map
from placegraph.core.threads import count_processors, limit_threads
from placegraph.errors import InputError, MapError, OptionError
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import PoseSearchOptions, check_device
from placegraph.indoor.track.belief import (
    JUMP,
    Belief,
    checked_covariance,
    checked_odometry,
    checked_pose,
)
from placegraph.indoor.track.tracker import Relocalizer, RelocalizingTracker, SceneSource
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.core.geometry import Camera
    from placegraph.indoor.track.belief import LivePose
    from placegraph.indoor.track.tracker import FrameResult, Relocalization, RelocalizationResult


class Inline(Executor):
    """Executor that runs tasks at once in the caller's thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401
        """Run a task."""
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Worker:
    """Worker that passes images to a tracker, relocalizations to maps, and results to a belief.

    Of images that come too fast only the newest counts. At most one job follows images, and one searches
    lost frames; `changed` guards the belief and all fields here.
    """

    def __init__(
        self,
        tracker: RelocalizingTracker,
        belief: Belief,
        changed: Condition,
        background: bool | Executor,
    ) -> None:
        self.dropped = 0
        self.status_counts: Counter[str] = Counter()
        self._tracker, self._belief, self._changed = tracker, belief, changed
        self._own = not isinstance(background, Executor)
        self._executor = background if isinstance(background, Executor) else Inline()
        if background is True:
            self._executor = ThreadPoolExecutor(2, thread_name_prefix="placegraph-live")
        self._seen = -np.inf
        self._heard = belief.epoch
        self._inbox: Frame | None = None
        self._answer: RelocalizationResult | None = None
        self._busy = self._searching = False
        self._failed: BaseException | None = None

    def discard_image(self) -> None:
        """Drop an image from before odometry restarted; lock held."""
        self.dropped += self._inbox is not None
        self._inbox, self._seen = None, -np.inf

    def is_late(self, frame: Frame) -> bool:
        """Return whether a newer image has come already; one much older means that the clock was set back."""
        return bool(self._seen - JUMP <= frame.stamp <= self._seen)

    def take(self, frame: Frame) -> bool:
        """Keep an image, and return whether a job must be submitted; lock held."""
        self._seen = frame.stamp
        self.dropped += self._inbox is not None
        self._inbox = frame
        idle, self._busy = not self._busy, True
        return idle

    def send(self) -> None:
        """Submit a job that follows images; without the lock."""
        self._executor.submit(self._work)

    def wait(self) -> None:
        """Wait until all images and relocalizations are done; lock held."""
        self._changed.wait_for(lambda: self._failed or not (self._busy or self._searching))
        self.check()

    def check(self) -> None:
        """Raise the error that ended the worker; lock held."""
        if self._failed is not None:
            raise self._failed

    def close(self) -> None:
        """End threads; without the lock."""
        with self._changed:
            self._inbox = None
            self._failed = self._failed or OptionError("The tracker is closed; create another.")
            self._changed.notify_all()
        if self._own:
            self._executor.shutdown(wait=True, cancel_futures=True)

    def _work(self) -> None:
        """Follow images and accept answers until none is left."""
        looked = False
        try:
            while True:
                with self._changed:
                    epoch, frame, found = self._belief.epoch, self._next(), self._answer
                    self._answer = None
                    if looked and (frame is not None or found is None):  # its result is known
                        self.status_counts[self._belief.status.name] += 1
                        looked = False
                    if frame is None and found is None:
                        self._busy = False
                        self._changed.notify_all()
                        return
                    if epoch != self._heard:
                        self._heard, found = epoch, None
                        self._tracker.reset(self._belief.near)
                if found is not None:
                    self._publish(epoch, self._tracker.take_answer(found))
                if frame is not None:
                    self._publish(epoch, self._tracker.follow(frame))
                    self._ask(epoch)
                    looked = True
        except BaseException as error:  # noqa: BLE001  # raised in the next call
            self._fail(error)

    def _next(self) -> Frame | None:
        """Return the next image with odometry at its time; lock held."""
        frame, self._inbox = self._inbox, None
        if frame is None:
            return None
        sample, why = self._belief.find_odometry(frame)
        if sample is not None:
            return replace(frame, odometry=sample.pose)
        self.dropped += 1
        self._belief.keep_pose(why)
        return None

    def _publish(self, epoch: int, result: FrameResult | None) -> None:
        """Update the belief by a result, unless it restarted meanwhile."""
        with self._changed:
            if result is not None and epoch == self._belief.epoch:
                self._belief.update(result)

    def _ask(self, epoch: int) -> None:
        """Submit a relocalization, if one is due."""
        with self._changed:
            question = None if self._searching else self._tracker.question()
            self._searching |= question is not None
        if question is not None:
            self._executor.submit(self._search, epoch, question)

    def _search(self, epoch: int, question: Relocalization) -> None:
        try:
            with limit_threads(
                max(1, count_processors() - 1)
            ):  # a core is left to those that follow
                found = question.search(self._tracker.relocalizer)
        except BaseException as error:  # noqa: BLE001  # raised in the next call
            self._fail(error)
            return
        with self._changed:
            self._searching = False
            self._answer = found if epoch == self._belief.epoch else None
            idle, self._busy = not self._busy, True
        if idle:
            self.send()

    def _fail(self, error: BaseException) -> None:
        with self._changed:
            self._busy = self._searching = False
            self._failed = self._failed or error
            self._changed.notify_all()


KIND = "track"
VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class SavedPose:
    """Pose and odometry of one time, as a file."""

    scene: str
    """Name of its map ..."""
    digest: str
    """... and what tells it from another map of that name (`digest_of`)."""
    stamp: float
    moved: bool
    """Whether odometry came by itself, and not with images."""
    odom_from_camera: Floats
    map_from_camera: Floats
    covariance: Floats
    """(6, 6)"""

    def write(self, path: str | PathLike[str]) -> None:
        """Write the file atomically; `MapError` if it cannot be written."""
        meta = {"scene": self.scene, "digest": self.digest, "moved": self.moved}
        names = ("odom_from_camera", "map_from_camera", "covariance")
        arrays = {name: np.asarray(getattr(self, name), np.float64) for name in names}
        write_map(path, KIND, VERSION, meta, arrays | {"stamp": np.array([self.stamp], np.float64)})

    @classmethod
    def read(cls, path: str | PathLike[str]) -> SavedPose:
        """Read the file; `InputError` if it is missing, `MapError` if it is damaged."""
        if not Path(path).exists():
            raise InputError(f"{path} does not exist; `LiveTracker.save` writes it.")
        file = read_map(path, KIND, VERSION)
        try:
            stamp, odometry, _ = checked_odometry(
                file.array("stamp", "<f8")[0], file.array("odom_from_camera", "<f8", 2), None
            )
            return cls(
                scene=_text(file.meta["scene"]),
                digest=_text(file.meta["digest"]),
                stamp=stamp,
                moved=bool(file.meta["moved"]),
                odom_from_camera=odometry,
                map_from_camera=checked_pose(
                    "map_from_camera", file.array("map_from_camera", "<f8", 2)
                ),
                covariance=checked_covariance("covariance", file.array("covariance", "<f8", 2)),
            )
        except (OptionError, KeyError, TypeError, IndexError) as error:
            raise MapError(
                f"{path}: its columns contradict each other ({error}). Save it again."
            ) from error


def digest_of(scene: Scene) -> str:
    """Return a digest of a map: of its surfaces and the ids of its objects."""
    sha = hashlib.sha256("\n".join(scene.graph.ids).encode())
    for column in (scene.mesh.vertices, scene.mesh.triangles):
        sha.update(np.ascontiguousarray(column).data)
    return sha.hexdigest()[:32]


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not text")
    return value


class LiveTracker:
    """Live tracker: pose of a camera at any time, from asynchronous odometry and images.

    Each image corrects the pose of the one before. If the pose is unknown, images are searched in the whole
    map, or library, while odometry continues the pose. The state is the pose of odometry's frame in the
    map, so a late image corrects the pose at the image's own time. Maps are only read. Time and memory are
    bounded. All methods may be called from any thread.

    Parameters
    ----------
    maps
        A scene map, or a library of several.
    camera
        Camera of the images; that of the first image if not given. Each image has its own intrinsics:
        a camera may refocus, but images of another size or view are refused.
    seed
        Seed of all random numbers; without `background` the same calls give the same poses.
    background
        True: the tracker's own threads process images, and drop those that come too fast. An executor:
        its threads do. False: `see` processes the image itself.
    **known
        options, encoder and device, as of `SceneMap.localize`.

    Raises
    ------
    OptionError
        The options cannot be used frame by frame (`FilterOptions.tracked`); the device is unknown.

    """

    def __init__(
        self,
        maps: Scene | SceneSource,
        camera: Camera | None = None,
        *,
        seed: int = 0,
        background: bool | Executor = True,
        **known: Any,  # noqa: ANN401  # of `SceneMap.localize`
    ) -> None:
        options = known.get("options") or PoseSearchOptions()
        if not options.tracked:
            raise OptionError("options: a live tracker needs start='table' and answer='fit'.")
        check_device(known.get("device", "auto"), network=True)
        self.maps, self.camera = maps, camera
        self._relocalizer = Relocalizer(maps, known)
        self._tracker = RelocalizingTracker(self._relocalizer, camera, seed)
        self._belief = Belief(options.motion)
        self._changed = Condition()
        self._worker = Worker(self._tracker, self._belief, self._changed, background)

    @property
    def dropped(self) -> int:
        """Return the number of dropped images: too many, too late, or of another time."""
        return self._worker.dropped

    @property
    def late(self) -> int:
        """Return the number of odometry samples that came after newer ones, and were dropped."""
        return self._belief.late

    @property
    def status_counts(self) -> Counter[str]:
        """Return the number of images by the status after each."""
        with self._changed:
            return self._worker.status_counts.copy()

    def move(
        self, stamp: float, odom_from_camera: ArrayLike, covariance: ArrayLike | None = None
    ) -> LivePose:
        """Add a sample of odometry, and return the pose there, within a fraction of a millisecond.

        Parameters
        ----------
        stamp
            Time [s] on the clock of the images. A sample older than the newest is dropped and counted in
            `late`. If it is older by more than a second, the clock was set back.
        odom_from_camera
            (4, 4) pose of the camera's optical frame in odometry's frame [m]: that of the robot's base
            times the mounting of the camera, ``odom_from_base @ base_from_camera``
        covariance
            (6, 6) covariance of this pose in the axes of odometry's frame, accumulated since the start, as
            in ``nav_msgs/Odometry``. Zeros mean unknown.

        Raises
        ------
        OptionError
            The time, pose or covariance is invalid; the tracker is closed.

        """
        sample = checked_odometry(stamp, odom_from_camera, covariance)
        with self._changed:
            self._worker.check()
            if self._belief.tell(*sample, own=True):
                self._worker.discard_image()
            return self._belief.pose(None)

    def see(self, frame: Frame) -> None:
        """Add an image, which is processed later, and dropped if a newer one comes first.

        Its own odometry counts only until `move` is called. Broken or blank images are named in the reason
        of later poses.

        Raises
        ------
        OptionError
            The image is of another camera; the tracker is closed.

        """
        if self.camera is None:
            self.camera = self._tracker.camera = frame.camera
        if not frame.camera.is_refocused(self.camera):
            raise OptionError(
                "frame: its camera differs from the tracker's; create a tracker for this camera."
            )
        sample = checked_odometry(frame.stamp, frame.odometry, None)
        with self._changed:
            self._worker.check()
            if self._worker.is_late(frame):
                self._worker.dropped += 1
                return
            if not self._belief.moved and self._belief.tell(*sample, own=False):
                self._worker.discard_image()
            idle = self._worker.take(frame)
        if idle:
            self._worker.send()

    def step(self, frame: Frame) -> LivePose:
        """Add an image, wait until it is processed, and return the pose; nothing is dropped.

        Raises `OptionError` as `see` does.
        """
        self.wait()
        self.see(frame)
        self.wait()
        return self.pose(frame.stamp)

    def wait(self) -> None:
        """Wait until all images are processed."""
        with self._changed:
            self._worker.wait()

    def pose(self, stamp: float | None = None) -> LivePose:
        """Return the pose at a time [s], or at that of the newest odometry.

        Beyond the newest odometry motion is extrapolated for a quarter of a second; after a second the
        pose is not `OK`.
        """
        with self._changed:
            self._worker.check()
            return self._belief.pose(stamp)

    def place(self, map_from_camera: ArrayLike, covariance: ArrayLike, scene: str = "") -> None:
        """Set the current pose (``initialpose``), which images must confirm.

        Parameters
        ----------
        map_from_camera
            (4, 4) [m]
        covariance
            (6, 6), as `PoseMode.covariance`
        scene
            Name of the map in a library; the current one if not given.

        Raises
        ------
        OptionError
            The pose or covariance is invalid; no map, or more than one, has this name.

        """
        pose = checked_pose("map_from_camera", map_from_camera)
        spread = checked_covariance("covariance", covariance)
        with self._changed:
            anchor = self._belief.anchor
            name = self._relocalizer.resolve_scene(scene or (anchor.scene if anchor else ""))
            why = "The pose was given; no image has confirmed it."
            self._belief.believe(pose, spread, name, why)

    def lose(self) -> None:
        """Forget the pose and search everywhere (``reinitialize_global_localization``)."""
        with self._changed:
            self._belief.forget("The pose was reset on request.")

    def save(self, path: str | PathLike[str]) -> None:
        """Write the current pose, its map's name and digest to a file (atomically), such as robot.track.

        Raises
        ------
        OptionError
            The pose is unknown.
        MapError, MapLockedError
            The file cannot be written.

        """
        with self._changed:
            pose, now = self._belief.pose(None), self._belief.odometry.newest
            moved = self._belief.moved
        if now is None or pose.map_from_camera is None or pose.covariance is None:
            raise OptionError(f"There is no pose to save. {pose.reason}")
        digest = digest_of(self._relocalizer.scene(pose.scene))
        SavedPose(
            pose.scene, digest, now.stamp, moved, now.pose, pose.map_from_camera, pose.covariance
        ).write(path)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        maps: Scene | SceneSource,
        **options: Any,  # noqa: ANN401
    ) -> Self:
        """Make a tracker that starts at a saved pose, which images must confirm.

        Odometry may go on or restart.

        Parameters
        ----------
        path
            File that `save` wrote.
        maps, **options
            As of the class.

        Raises
        ------
        InputError, MapError
            The file is missing, damaged, no saved tracker, or belongs to another map.

        """
        saved = SavedPose.read(path)
        live = cls(maps, **options)
        try:
            same = (
                digest_of(live._relocalizer.scene(live._relocalizer.resolve_scene(saved.scene)))
                == saved.digest
            )
        except OptionError as error:
            raise MapError(f"{path} belongs to another map: {error}") from error
        if not same:
            raise MapError(
                f"{path} was saved with another map named {saved.scene!r}; open that map, "
                "or start again."
            )
        belief = live._belief
        belief.tell(saved.stamp, saved.odom_from_camera, None, own=saved.moved)
        why = "The pose was loaded; no image has confirmed it."
        belief.believe(saved.map_from_camera, saved.covariance, saved.scene, why)
        return live

    def close(self) -> None:
        """End the threads; the image in progress is finished first."""
        self._worker.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
