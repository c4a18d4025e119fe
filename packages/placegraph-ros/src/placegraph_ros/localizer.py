"""Localizer of a robot, without ROS: sensor messages in, pose messages out.

`run` is the loop of all front ends: it reads events of a source (`sources`) and hands messages to sinks: a
bag, a recording, a viewer (`foxglove`), or a node of ROS 2 (`node`).
"""

from __future__ import annotations

from collections import Counter, deque
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
from placegraph_io.ros.topics import CapturePlan, TopicChoice
from placegraph_ros.message import Message, nanoseconds
from placegraph_ros.options import LiveOptions, Summary
from placegraph_ros.pose_messages import TICK, PoseReporter, frame_ids
from placegraph_ros.scene_messages import image_messages

if TYPE_CHECKING:
    from placegraph.indoor.library.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap

DEFAULT_VARIANCES = np.array([0.5, 0.5, 1.0, 0.1, 0.1, 0.26]) ** 2
"""Variances [m^2, rad^2] that replace zeros of an initial pose: RViz sets none for the height."""
_STAMPS = 1000  # stamps of recent frames
_REASONS = 20  # counted separately; all further ones as one


class Localizer:
    """Localizer that takes sensor messages and returns messages about the pose; bad input is counted.

    `maps`: a scene map, or a library of several; `options`: `LiveOptions`; `plan`: topics that make
    frames, if known; else they are chosen after a second; `name`, `choice`: name of the stream in
    messages, and the user's topics; `**known`: options, encoder and device of `SceneMap.localize`.

    Raises `OptionError`: an option of `LiveTracker` is invalid.
    """

    def __init__(
        self,
        maps: SceneMap | SceneLibrary,
        options: LiveOptions | None = None,
        *,
        plan: CapturePlan | None = None,
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
        self._counts: Counter[str] = Counter()  # of statuses, in maps before this one
        self._covariance_fault = ""  # why odometry's covariance is not used
        self.frames = self._dropped = 0
        self._pending_pose: tuple[Floats, Floats] | None = None
        self._start(maps)
        if plan is not None:
            self._choose(plan)

    def _start(self, maps: SceneMap | SceneLibrary) -> None:
        options = self.options
        self.tracker = LiveTracker(
            maps, seed=options.seed, background=options.background, **self._known
        )
        names = frame_ids(options, self._assembly)
        self._reporter = PoseReporter(
            maps, names, options.tolerance, with_inputs=options.with_inputs
        )
        self._live: LivePose | None = None  # after the last motion
        self._looks_at_images = True  # whether images are used
        self._moves = False
        self._motions: deque[tuple[float, Floats]] = deque()  # not reported yet
        self._newest: tuple[float, Floats] | None = None  # reported last

    @property
    def topics(self) -> frozenset[str] | None:
        """Names of the topics that make frames; None while unknown."""
        return None if self._assembly is None else self._assembly.topics

    def take(self, event: Packet | Fault | Frame | None) -> list[Message]:
        """Return the messages after a packet, a frame, a fault, or (None) a timeout."""
        messages: list[Message] = []
        if isinstance(event, Packet):
            messages = self._take_packet(event)
        elif isinstance(event, Frame):
            messages = self._take_frame(event)
        elif isinstance(event, Fault):
            messages = self._count_fault(event.topic, event.reason)
        return messages + self._report_motions() + self._report_changes()

    def finish(self) -> list[Message]:
        """Return the messages at the end of the stream."""
        messages: list[Message] = []
        is_unplanned = self._assembly is None and not self.frames
        if is_unplanned and (plan := self._discovery.find_plan()) is not None:
            messages += self._begin_stream(plan)
        if self._assembly is not None:
            for part in self._assembly.finish():
                messages += self._part(part)
        messages += self._report_motions()
        self.tracker.wait()
        if self.options.background and self._newest is not None:  # after the last image
            self._motions.append((self._newest[0] + TICK, self._newest[1]))
        return messages + self._report_motions() + self._report_changes()

    def _take_packet(self, packet: Packet) -> list[Message]:
        if self._assembly is not None:
            return self._assemble(self._assembly, packet)
        plan = self._discovery.take(packet)
        if plan is not None:
            return self._begin_stream(plan)
        missing = self._discovery.missing
        return self._reporter.report_lack(missing[0], packet.time) if missing else []

    def _begin_stream(self, plan: CapturePlan) -> list[Message]:
        """Start with the packets that arrived before the plan was complete."""
        assembly = self._choose(plan)
        messages: list[Message] = []
        for packet in self._discovery.packets():
            messages += self._assemble(assembly, packet)
        return messages

    def _choose(self, plan: CapturePlan) -> FrameAssembly:
        self._assembly = FrameAssembly(plan)
        self._reporter.restart(frame_ids(self.options, self._assembly))
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
        motion = part.stamp, part.odometry_from_camera
        try:
            live = self.tracker.move(*motion, part.covariance)
        except OptionError as error:
            live = self.tracker.move(*motion)
            self._covariance_fault = f"The covariance of odometry is not used: {error}"
        self._live = None if self._update_mount() else live
        self._motions.append(motion)
        return []

    def _report_motions(self) -> list[Message]:
        """Return odometry and transforms; those at and after an image that is used at once wait for it."""
        waits = not self.options.background and self._assembly is not None
        until = self._assembly.oldest_waiting if waits and self._assembly is not None else np.inf
        messages: list[Message] = []
        while self._motions and self._motions[0][0] < until:
            self._newest = motion = self._motions.popleft()
            try:
                messages += self._reporter.report_motion(self.tracker.pose(motion[0]), *motion)
            except OptionError as error:  # an invalid clock
                self._count_fault("odometry", str(error))
        return messages

    def _update_mount(self) -> bool:
        """Update the mount of the camera, and use a pending pose; return whether there was one."""
        mount = self._assembly.base_from_camera() if self._assembly is not None else None
        if mount is not None:
            self._reporter.base_from_camera = mount
        pending, self._pending_pose = self._pending_pose, None
        if pending is not None:
            self.place(*pending)
        return pending is not None

    def _take_frame(self, frame: Frame) -> list[Message]:
        """Use a frame, or queue it."""
        self._live = None
        self.frames += 1
        self._stamps[frame.index % _STAMPS] = frame.stamp
        messages: list[Message] = []
        try:
            nanoseconds(frame.stamp)  # raises for an invalid clock
            if self.options.with_inputs:
                messages += image_messages(frame, frame.stamp, self._reporter.frames)
            if self._looks_at_images:
                self.tracker.see(frame)
        except (InputError, OptionError) as error:
            return messages + self._count_fault("a frame", str(error))
        if not self._moves:  # no odometry beside the images
            self._update_mount()
        if not (self._moves and self.options.background):  # the transforms of the pose's own stamp
            later = [motion for motion in self._motions if motion[0] > frame.stamp]
            earlier = [motion for motion in self._motions if motion[0] < frame.stamp]
            self._motions = deque([*earlier, (frame.stamp, frame.odometry), *later])
        return messages

    def _report_changes(self) -> list[Message]:
        """Return messages about what images changed."""
        live, self._live = self._live or self.tracker.pose(), None
        newest = -np.inf if self._assembly is None else self._assembly.newest
        if newest > live.stamp:  # odometry may have ended
            live = self.tracker.pose(newest)
        self._reason = live.reason
        if self.options.mode == "once" and live.status is Status.OK:
            self._looks_at_images = False
        if self.frames:
            return self._reporter.report_changes(live, self._stamp_of(live))
        return self._reporter.report_unusable(self.summary.left_out, newest)

    def _stamp_of(self, live: LivePose) -> float:
        """Return the stamp of the last image that was used [s]."""
        if live.estimate is None or not len(live.estimate.frames):
            return live.stamp
        return self._stamps.get(int(live.estimate.frames[-1]) % _STAMPS, live.stamp)

    def _count_fault(self, where: str, reason: str) -> list[Message]:
        entry = f"{where or 'the stream'}: {reason}"
        self._left_out[entry if len(self._left_out) < _REASONS else "other reasons"] += 1
        return []

    def place(self, map_from_base: Floats, covariance: Floats) -> list[Message]:
        """Use an initial pose of the robot's base (``initialpose``): (4, 4), and (6, 6) in ROS's order.

        Variances of 0 are replaced by defaults. Invalid poses are refused, as the status says.
        """
        if self.frames == 0:  # the mount of the camera is unknown
            self._pending_pose = map_from_base, covariance
            return []
        spread = np.array(covariance, np.float64)
        unset = np.diag(spread) == 0.0
        spread[unset] = spread[:, unset] = 0.0
        spread[np.diag_indices(6)] += np.where(unset, DEFAULT_VARIANCES, 0.0)
        try:
            self.tracker.place(np.asarray(map_from_base) @ self._reporter.base_from_camera, spread)
        except OptionError as error:
            live = self.tracker.pose()
            reason = f"The initial pose is not used: {error}"
            return self._reporter.report_status(live.status, reason, live.stamp, live=live)
        self._looks_at_images = True
        return self._report_changes()

    def relocalize(self) -> list[Message]:
        """Drop the pose, and localize in the whole map (``reinitialize_global_localization``)."""
        self.tracker.lose()
        return self.update()

    def update(self) -> list[Message]:
        """Use the next image in any case (``request_nomotion_update``)."""
        self._looks_at_images = True
        return self._report_changes()

    def change(self, options: LiveOptions) -> list[Message]:
        """Change the mode and the tolerance of transforms."""
        self.options = options
        self._reporter.tolerance = options.tolerance
        self._looks_at_images |= options.mode == "continuous"
        return []

    def load(self, maps: SceneMap | SceneLibrary) -> list[Message]:
        """Change the map, without a pose (``load_map``)."""
        self.tracker.close()
        self._dropped += self.tracker.dropped
        self._counts += self.tracker.status_counts
        mount = self._reporter.base_from_camera
        self._start(maps)
        self._reporter.base_from_camera = mount
        return self._report_changes()

    @property
    def summary(self) -> Summary:
        """Counts of the frames so far, what is missing, and notes."""
        parts, left_out, notes = self._assembly, Counter(self._left_out), []
        if parts is not None:
            left_out += parts.left_out
            notes += parts.plan.notes
            if parts.jumps:
                notes.append(f"The clock was set back {parts.jumps} times.")
        missing = self._discovery.missing if parts is None else ()
        if self._covariance_fault:
            notes.append(self._covariance_fault)
        statuses = self._counts + self.tracker.status_counts
        if self.frames and not statuses[Status.OK.name]:
            notes.append(f"No pose was certain: {self._reason}")
        dropped = self._dropped + self.tracker.dropped
        return Summary(self.frames, statuses, dropped, left_out, missing, tuple(notes))

    def close(self) -> None:
        """End the tracker's threads."""
        self.tracker.close()


Request = Callable[[Localizer], list[Message]]


class Sink(Protocol):
    """Receiver of messages: a bag, a recording, a viewer, a node."""

    def write(self, message: Message) -> None:
        """Write a message."""


def run(
    events: Iterable[Packet | Fault | Frame | Request | None],
    localizer: Localizer,
    sinks: Sequence[Sink],
    report: Callable[[Localizer], None] | None = None,
) -> Summary:
    """Feed events to a localizer until they end, write its messages to the sinks, and close it.

    `events` are packets, frames, functions of the localizer, or None (a timeout); `report` is called
    after each.
    """
    with ExitStack() as stack:
        stack.callback(localizer.close)

        def send(messages: list[Message]) -> None:
            for message in messages:
                for sink in sinks:
                    sink.write(message)
            if report is not None:
                report(localizer)

        for event in events:
            send(event(localizer) if callable(event) else localizer.take(event))
        send(localizer.finish())
        return localizer.summary
