"""The localizer of a robot, without ROS: messages of sensors in, messages about the pose out.

`run` is the one loop of all faces: it takes events of any source (`sources`) and hands messages to sinks: a
bag, a recording, a viewer (`foxglove`), or a node of ROS 2 (`node`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from placegraph.core.estimate import Status
from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.track.belief import LivePose
from placegraph.indoor.track.live import LiveTracker
from placegraph.io.capture.frame import Frame
from placegraph_io.ros.stream import Fault, FrameAssembly, OdometryPose, Packet, StreamDiscovery
from placegraph_io.ros.topics import Plan, TopicChoice
from placegraph_ros.message import Message, nanoseconds
from placegraph_ros.options import LiveOptions, Summary
from placegraph_ros.pose_messages import PoseReporter, frame_ids
from placegraph_ros.scene_messages import image_messages

if TYPE_CHECKING:
    from placegraph.indoor.library.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap

UNTOLD = np.array([0.5, 0.5, 1.0, 0.1, 0.1, 0.26]) ** 2
"""Variances [m^2, rad^2] of a told pose where it says 0, which no pose has: RViz tells no height."""
_REMEMBERED = 1000  # stamps of frames whose answers may still come
_REASONS = 20  # for which something is left out, before all others are one


class Localizer:
    """Takes what sensors say, and tells where the robot is; whatever comes, it goes on.

    Parameters
    ----------
    maps
        A scene map, or a library of several.
    options
        `LiveOptions`.
    plan
        What frames are made of, where it is known; else the stream is listened to for a second.
    name, choice
        What the stream is called in messages, and what the user says of it.
    **known
        options, encoder and device, as of `SceneMap.localize`.

    Raises
    ------
    OptionError
        As of `LiveTracker`.

    """

    def __init__(
        self,
        maps: SceneMap | SceneLibrary,
        options: LiveOptions | None = None,
        *,
        plan: Plan | None = None,
        name: str = "stream",
        choice: TopicChoice | None = None,
        **known: Any,  # noqa: ANN401  # of `SceneMap.localize`
    ) -> None:
        self.options = options or LiveOptions()
        self._known = known
        self._discovery = StreamDiscovery(Path(name), choice or TopicChoice())
        self._assembly: FrameAssembly | None = None
        self._left_out: Counter[str] = Counter()
        self._stamps: dict[int, float] = {}
        self._reason = ""
        self._told: Counter[str] = Counter()  # in maps before this one
        self._covariance_fault = ""  # why odometry's covariance is not used
        self.frames = self._dropped = 0
        self._placed: tuple[Floats, Floats] | None = None
        self._begin(maps)
        if plan is not None:
            self._choose(plan)

    def _begin(self, maps: SceneMap | SceneLibrary) -> None:
        options = self.options
        self.tracker = LiveTracker(
            maps, seed=options.seed, background=options.background, **self._known
        )
        names = frame_ids(options, self._assembly)
        self._reporter = PoseReporter(maps, names, options.tolerance, whole=options.whole)
        self._live: LivePose | None = None  # as it is after the last move
        self._wanted = True  # whether images are to be looked at
        self._moves = False
        self._carried: tuple[float, Floats] | None = None

    @property
    def topics(self) -> frozenset[str] | None:
        """Names of the topics that frames are made of; None while that is not known."""
        return None if self._assembly is None else self._assembly.topics

    def take(self, event: Packet | Fault | Frame | None) -> list[Message]:
        """Return what is known after a message, a frame, or (None) after a while."""
        messages: list[Message] = []
        if isinstance(event, Packet):
            messages = self._take_packet(event)
        elif isinstance(event, Frame):
            messages = self._take_frame(event)
        elif isinstance(event, Fault):
            messages = self._count_fault(event.topic, event.reason)
        return messages + self._report_changes()

    def finish(self) -> list[Message]:
        """Return what is known when the stream has ended."""
        messages: list[Message] = []
        if (
            self._assembly is None
            and not self.frames
            and (plan := self._discovery.find_plan()) is not None
        ):
            messages += self._begin_stream(plan)
        if self._assembly is not None:
            for part in self._assembly.finish():
                messages += self._part(part)
        self.tracker.wait()
        if self.options.background and self._carried is not None:  # by what the last image told
            messages += self._reporter.report_motion(self.tracker.pose(), *self._carried)
        return messages + self._report_changes()

    def _take_packet(self, packet: Packet) -> list[Message]:
        if self._assembly is not None:
            return self._assemble(self._assembly, packet)
        plan = self._discovery.take(packet)
        if plan is not None:
            return self._begin_stream(plan)
        lacks = self._discovery.lacks
        return self._reporter.report_lack(lacks[0], packet.time) if lacks else []

    def _begin_stream(self, plan: Plan) -> list[Message]:
        """Begin with what was heard before it was known what frames are made of."""
        assembly = self._choose(plan)
        messages: list[Message] = []
        for packet in self._discovery.packets():
            messages += self._assemble(assembly, packet)
        return messages

    def _choose(self, plan: Plan) -> FrameAssembly:
        self._assembly = FrameAssembly(plan)
        self._reporter.begin(frame_ids(self.options, self._assembly))
        return self._assembly

    def _assemble(self, assembly: FrameAssembly, packet: Packet) -> list[Message]:
        messages: list[Message] = []
        try:
            for part in assembly.take(packet):
                messages += self._part(part)
        except (InputError, OptionError) as error:
            messages += self._count_fault(packet.topic, str(error))
        return messages

    def _part(self, part: Frame | OdometryPose) -> list[Message]:
        if isinstance(part, Frame):
            return self._take_frame(part)
        self._moves = True
        self._carried = part.stamp, part.odometry_from_camera
        try:
            live = self.tracker.move(*self._carried, part.covariance)
        except OptionError as error:
            live = self.tracker.move(*self._carried)
            self._covariance_fault = f"What odometry says of its own errors is not used: {error}"
        self._live = None if self._update_mount() else live
        return self._reporter.report_motion(live, *self._carried)

    def _update_mount(self) -> bool:
        """Know where the camera sits, and whether it was told before where it is: that counts now."""
        mount = self._assembly.base_from_camera() if self._assembly is not None else None
        if mount is not None:
            self._reporter.base_from_camera = mount
        told, self._placed = self._placed, None
        if told is not None:
            self.place(*told)
        return told is not None

    def _take_frame(self, frame: Frame) -> list[Message]:
        """Look at a frame, or have it looked at."""
        self._live = None
        self.frames += 1
        self._stamps[frame.index % _REMEMBERED] = frame.stamp
        messages: list[Message] = []
        try:
            nanoseconds(frame.stamp)  # of a clock that is none, nothing can be told
            if self.options.whole:
                messages += image_messages(frame, frame.stamp, self._reporter.frames)
            if self._wanted:
                self.tracker.see(frame)
        except (InputError, OptionError) as error:
            return messages + self._count_fault("a frame", str(error))
        if not self._moves:  # images alone tell odometry
            self._update_mount()
            self._carried = frame.stamp, frame.odometry
            messages += self._reporter.report_motion(self.tracker.pose(), *self._carried)
        return messages

    def _report_changes(self) -> list[Message]:
        """Return what images have changed since it was told."""
        live, self._live = self._live or self.tracker.pose(), None
        newest = -np.inf if self._assembly is None else self._assembly.newest
        if newest > live.stamp:  # odometry may have fallen silent
            live = self.tracker.pose(newest)
        self._reason = live.reason
        if self.options.mode == "once" and live.status is Status.OK:
            self._wanted = False
        if self.frames:
            return self._reporter.report_changes(live, self._stamp_of(live))
        return self._reporter.report_unusable(self.summary.left_out, newest)

    def _stamp_of(self, live: LivePose) -> float:
        """Return when the last image that told something was taken [s]."""
        if live.estimate is None or not len(live.estimate.frames):
            return live.stamp
        return self._stamps.get(int(live.estimate.frames[-1]) % _REMEMBERED, live.stamp)

    def _count_fault(self, where: str, reason: str) -> list[Message]:
        said = f"{where or 'the stream'}: {reason}"
        self._left_out[said if len(self._left_out) < _REASONS else "other reasons"] += 1
        return []

    def place(self, map_from_base: Floats, covariance: Floats) -> list[Message]:
        """Take where the robot's base is said to be (``initialpose``): (4, 4), and (6, 6) in ROS's order.

        A variance of 0 says nothing. What is no pose is refused, and the status says so.
        """
        if self.frames == 0:  # where the camera sits is not known yet
            self._placed = map_from_base, covariance
            return []
        spread = np.array(covariance, np.float64)
        unsaid = np.diag(spread) == 0.0
        spread[unsaid] = spread[:, unsaid] = 0.0
        spread[np.diag_indices(6)] += np.where(unsaid, UNTOLD, 0.0)
        try:
            self.tracker.place(np.asarray(map_from_base) @ self._reporter.base_from_camera, spread)
        except OptionError as error:
            live = self.tracker.pose()
            reason = f"The pose that was told is not taken: {error}"
            return self._reporter.report_status(live.status, reason, live.stamp, live=live)
        self._wanted = True
        return self._report_changes()

    def relocalize(self) -> list[Message]:
        """Forget the pose, and look for it everywhere (``reinitialize_global_localization``)."""
        self.tracker.lose()
        return self.update()

    def update(self) -> list[Message]:
        """Look at the next image in any case (``request_nomotion_update``)."""
        self._wanted = True
        return self._report_changes()

    def load(self, maps: SceneMap | SceneLibrary) -> list[Message]:
        """Go on in another map, where nothing is known yet (``load_map``)."""
        self.tracker.close()
        self._dropped += self.tracker.dropped
        self._told += self.tracker.told
        mount = self._reporter.base_from_camera
        self._begin(maps)
        self._reporter.base_from_camera = mount
        return self._report_changes()

    @property
    def summary(self) -> Summary:
        """What became of the frames so far."""
        parts, left_out, notes = self._assembly, Counter(self._left_out), []
        if parts is not None:
            left_out += parts.left_out
            notes += parts.plan.notes
            if parts.jumps:
                notes.append(f"The clock was set back {parts.jumps} times, and went on from there.")
        lacks = self._discovery.lacks if parts is None else ()
        if self._covariance_fault:
            notes.append(self._covariance_fault)
        told = self._told + self.tracker.told
        if self.frames and not told[Status.OK.name]:
            notes.append(f"No pose was sure: {self._reason}")
        dropped = self._dropped + self.tracker.dropped
        return Summary(self.frames, told, dropped, left_out, lacks, tuple(notes))

    def close(self) -> None:
        """End the tracker's threads."""
        self.tracker.close()


Request = Callable[[Localizer], list[Message]]


class Sink(Protocol):
    """What carries messages: a bag, a recording, a viewer, a node."""

    def write(self, message: Message) -> None:
        """Take a message."""


def run(
    events: Iterable[Packet | Fault | Frame | Request | None],
    localizer: Localizer,
    sinks: Sequence[Sink],
    told: Callable[[Localizer], None] | None = None,
) -> Summary:
    """Localize what happens until it ends, and close the localizer.

    Parameters
    ----------
    events
        Messages, frames, what somebody asks of the localizer, or None: time has gone by.
    localizer, sinks
        Who takes them, and who carries what it says.
    told
        Is called after each.

    """
    with ExitStack() as stack:
        stack.callback(localizer.close)

        def send(messages: list[Message]) -> None:
            for message in messages:
                for sink in sinks:
                    sink.write(message)
            if told is not None:
                told(localizer)

        for event in events:
            send(event(localizer) if callable(event) else localizer.take(event))
        send(localizer.finish())
        return localizer.summary
