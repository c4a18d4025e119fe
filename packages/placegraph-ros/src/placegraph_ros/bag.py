"""Writer of bags (MCAP, folders of rosbag2, bags of ROS 1), which appear when they are complete."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Self

from placegraph.core.files import lock_file, write_error
from placegraph.errors import OptionError
from placegraph_ros.message import Message, encode, load_types, nanoseconds, type_name


def check_free(path: Path) -> None:
    """Raise `OptionError` where a path exists."""
    if path.exists():
        raise OptionError(f"{path} already exists; remove it, or choose another file.")


@contextmanager
def report_disk_errors(path: Path) -> Iterator[None]:
    """Turn errors of the disk while `path` is written into `MapError`."""
    try:
        yield
    except OSError as error:
        raise write_error(path, error) from error
    except sqlite3.Error as error:  # of databases
        raise write_error(path, OSError(str(error))) from error


class UnfinishedFile:
    """Hidden folder beside a path, in which its file or folder is written under a lock.

    Raises `OptionError` where the path exists, `MapLockedError` where another process writes it,
    `MapError` where nothing can be written there.
    """

    def __init__(self, path: Path) -> None:
        check_free(path)
        self.path = path
        with report_disk_errors(path), ExitStack() as stack:
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(lock_file(path))
            self.folder = path.parent / tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent)
            self._locked = stack.pop_all()

    def finish(self, finished: Path) -> None:
        """Move the finished file or folder to its path; raises as the constructor."""
        check_free(self.path)
        with report_disk_errors(self.path):
            finished.rename(self.path)

    def drop(self) -> None:
        """Remove the hidden folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._locked.close()


Container = Literal["mcap", "sqlite3", "rosbag1"]
_ENDINGS: dict[str, Container] = {".mcap": "mcap", ".db3": "sqlite3", ".bag": "rosbag1"}


class BagWriter:
    """Writer of messages, a context manager; the bag appears when the context ends without an error.

    `path`: a file NAME.mcap, NAME.db3 (rosbag2's SQLite) or NAME.bag (ROS 1); any other name becomes a
    folder of rosbag2. It must not exist; `container`: format of a folder; ignored where the path has an
    ending; `packed`: whether chunks (of SQLite: messages) are compressed, by zstd or bz2.

    Raises `OptionError`: `path` exists; `MapError`: nothing can be written there; `MissingExtraError`:
    `rosbags` is not installed.
    """

    def __init__(
        self, path: str | PathLike[str], container: Container | None = None, *, packed: bool = False
    ) -> None:
        self.path = Path(path)
        ending = _ENDINGS.get(self.path.suffix.lower())
        self._container: Container = ending or container or "mcap"
        self._is_file = ending is not None
        self._encoding = "ros1" if self._container == "rosbag1" else "cdr"
        self._store = load_types(self._encoding)
        check_free(self.path)
        self._packed = packed
        self._topics: dict[tuple[str, str], Any] = {}
        self._place: UnfinishedFile | None = None
        self._writer: Any = None

    def __enter__(self) -> Self:
        self._place = UnfinishedFile(self.path)
        try:
            with report_disk_errors(self.path):
                self._writer = self._open_writer(self._place.folder / self.path.stem)
        except BaseException:
            self._place.drop()
            raise
        return self

    def __exit__(self, kind: object, *error: object) -> None:
        assert self._place is not None  # noqa: S101  entered
        bag = self._place.folder / self.path.stem
        try:
            if kind is not None:
                with suppress(Exception):  # the first error counts
                    self._writer.close()
                return
            with report_disk_errors(self.path):
                self._writer.close()
            one = bag.is_dir() and self._is_file
            self._place.finish(bag / f"{bag.name}{self.path.suffix.lower()}" if one else bag)
        finally:
            self._place.drop()
            self._place = self._writer = None

    def write(self, message: Message) -> None:
        """Write a message at its stamp.

        Raises `OptionError` for an unknown type, a field that does not fit it or a stamp out of ROS's
        range; `MapError` where the disk is full.
        """
        data = encode(message, self._encoding)
        self.write_bytes(message.topic, message.type, message.stamp, data, latched=message.latched)

    def write_bytes(
        self, topic: str, kind: str, stamp: float, data: bytes, *, latched: bool = False
    ) -> None:
        """Write the bytes of a message of a type such as `sensor_msgs/msg/Image`, at a stamp [s]."""
        if self._writer is None:
            raise OptionError("The bag is not open; write inside `with BagWriter(path) as bag`.")
        name, at = "/" + topic.lstrip("/"), nanoseconds(stamp)
        if (name, kind) not in self._topics:
            self._topics[name, kind] = self._connection(name, kind, latched=latched)
        with report_disk_errors(self.path):
            self._writer.write(self._topics[name, kind], at, data)

    def _open_writer(self, bag: Path) -> Any:  # noqa: ANN401  # of rosbags
        from rosbags import rosbag1, rosbag2

        if self._container == "rosbag1":
            writer: Any = rosbag1.Writer(bag)
            if self._packed:
                writer.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
        else:
            plugin = rosbag2.StoragePlugin[self._container.upper()]
            writer = rosbag2.Writer(bag, version=8, storage_plugin=plugin)
            if self._packed:
                modes = rosbag2.CompressionMode
                mode = modes.STORAGE if self._container == "mcap" else modes.MESSAGE
                writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
        writer.open()
        return writer

    def _connection(self, topic: str, kind: str, *, latched: bool) -> Any:  # noqa: ANN401
        name = type_name(kind, self._store)
        if self._encoding == "ros1":
            return self._writer.add_connection(
                topic, name, typestore=self._store, latching=1 if latched else None
            )
        offered = (_latched_qos(),) if latched else ()
        return self._writer.add_connection(
            topic, name, typestore=self._store, offered_qos_profiles=offered
        )


def _latched_qos() -> Any:  # noqa: ANN401  # of rosbags
    """Return the quality of service of latched topics: reliable, transient local."""
    from rosbags import interfaces

    zero = interfaces.QosTime(0, 0)
    return interfaces.Qos(
        interfaces.QosHistory.KEEP_LAST, 1, interfaces.QosReliability.RELIABLE,
        interfaces.QosDurability.TRANSIENT_LOCAL, zero, zero,
        interfaces.QosLiveliness.SYSTEM_DEFAULT, zero, avoid_ros_namespace_conventions=False,
    )  # fmt: skip
