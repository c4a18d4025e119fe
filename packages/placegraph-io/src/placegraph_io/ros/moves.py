"""Messages of transforms as rows of numbers: most of them many at once."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from struct import unpack_from
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import cross_matrix
from placegraph_io.ros.decode import decode, frame_of, stamp_of
from placegraph_io.ros.files.storage import Topic
from placegraph_io.ros.transforms import Samples

Moves = dict[tuple[str, str], list[NDArray[np.float64]]]
"""By parent and child: rows (N, 9) of time of recording and stamp [s], x, y, z [m], qx, qy, qz, qw."""
_NUMBERS = 56  # bytes of a transform's numbers, which stand last
_STAMP = 8  # where the stamp of a message's first transform stands, in ROS 1 and ROS 2


def transforms(
    data: list[bytes], topic: Topic, path: Path, window: tuple[int, int] | None
) -> Moves:
    """Transforms of a topic's messages that were recorded within a window [ns] (None: always).

    Messages of one transform between the same frames differ in stamp and numbers alone: of those
    the first is decoded, and of the others these are taken.
    """
    groups: dict[bytes | int, list[tuple[int, bytes]]] = defaultdict(list)
    ros1 = topic.encoding == "ros1"
    head = b"\1\0\0\0" if ros1 else b"\0\1\0\0\1\0\0\0"  # one transform, little-endian
    for row, (time, raw) in enumerate(zip(topic.times.tolist(), data, strict=True)):
        if window is None or window[0] < time < window[1]:
            one = raw.startswith(head) and len(raw) >= _STAMP + 8 + _NUMBERS
            groups[raw[_STAMP + 8 : -_NUMBERS] if one else row].append((time, raw))
    out: Moves = defaultdict(list)
    for group in groups.values():
        where = f"{path}, {topic.name}"
        for t in decode(group[0][1], where, topic.type, topic.encoding).transforms:
            rows = np.empty((len(group), 9))
            rows[:, 0] = np.array([time for time, _ in group]) * 1e-9
            rows[0, 1:] = (
                stamp_of(t.header),
                *numbers_of(t.transform.translation, t.transform.rotation),
            )
            _fill(rows[1:], [raw for _, raw in group[1:]], signed=not ros1)
            out[frame_of(t.header.frame_id), frame_of(t.child_frame_id)].append(rows)
    return dict(out)


def _fill(rows: NDArray[np.float64], raws: list[bytes], *, signed: bool) -> None:
    """Stamps and numbers of messages of one transform each."""
    form = "<iI" if signed else "<II"
    rows[:, 1] = [s + n * 1e-9 for s, n in (unpack_from(form, raw, _STAMP) for raw in raws)]
    numbers = b"".join(raw[-_NUMBERS:] for raw in raws)
    rows[:, 2:] = np.frombuffer(numbers, "<f8").reshape(-1, 7)


def samples_of(held: Iterable[Moves], *, recorded: bool) -> Samples:
    """Samples of the transforms of all topics, by their stamps or by the times of recording."""
    out: Samples = defaultdict(list)
    for moves in held:
        for key, rows in moves.items():
            out[key] += [np.delete(r, 1 if recorded else 0, axis=1) for r in rows]
    return out


def numbers_of(move: Any, turn: Any) -> tuple[float, ...]:  # noqa: ANN401  # rosbags'
    """x, y, z, qx, qy, qz, qw of a position and a quaternion."""
    return move.x, move.y, move.z, turn.x, turn.y, turn.z, turn.w


class Spread(NamedTuple):
    """How far odometry may be off, by its own account, and where it has the robot."""

    covariance: NDArray[np.float64]
    """(6, 6) of x, y, z [m] and a turn about its frame's axes [rad]; it may hold anything."""
    position: NDArray[np.float64]
    """(3,) [m]"""

    @classmethod
    def of(cls, said: Any) -> Self:  # noqa: ANN401  # rosbags'
        """Of a `geometry_msgs/PoseWithCovariance`."""
        at = said.pose.position
        covariance = np.array(said.covariance, np.float64).reshape(6, 6)
        return cls(covariance, np.array([at.x, at.y, at.z]))

    def at(
        self, odometry_from_camera: NDArray[np.float64], lean: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(6, 6) of a camera on the robot, in axes that `lean` leads odometry's to; both are (4, 4)."""
        swing = np.eye(6)
        swing[:3, 3:] = -cross_matrix(odometry_from_camera[:3, 3] - self.position)
        swing = np.kron(np.eye(2), lean[:3, :3]) @ swing
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(swing @ self.covariance @ swing.T)
