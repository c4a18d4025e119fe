"""Server of messages for Foxglove, and its layout for bags."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any, Self

from placegraph.core.files import write_file
from placegraph.errors import MissingExtraError, OptionError, ServiceError
from placegraph_io.ros.containers import open_bag
from placegraph_io.ros.topics import camera_info_names, choose_images, inspect_images
from placegraph_ros.message import Message, cdr, definition, nanoseconds
from placegraph_ros.sources import PlaybackClock

_IMAGE = "/localization/image"


def layout(bag: str | PathLike[str] | None = None) -> dict[str, Any]:
    """Return the layout for Foxglove, with the bag's colour images if it holds any.

    Raises `InputError` for an invalid bag, `MissingExtraError` without `rosbags`.
    """
    text = files("placegraph_ros").joinpath("layout.json").read_text("utf-8")
    content: dict[str, Any] = json.loads(text)
    found = None if bag is None else open_bag(Path(bag))
    views = (
        [] if found is None else [v for v in inspect_images(found) if v.kind in {"colour", "grey"}]
    )
    if found is None or not views or any(view.topic.name == _IMAGE for view in views):
        return content
    colour, _ = choose_images(found, views, None, None, with_depth=False)
    infos = [name for name in camera_info_names(colour) if name in found.topics]
    shown = content["configById"]["Image!placegraph"]["imageMode"]
    shown["imageTopic"] = colour.topic.name
    shown["calibrationTopic"] = infos[0] if infos else ""
    return content


def write_layout(bag: str | PathLike[str]) -> Path:
    """Write the layout of a bag as BAG.layout.json; raises the errors of `layout`, or `MapError`."""
    path = Path(f"{bag}.layout.json")
    return write_file(path, [json.dumps(layout(bag), indent=2).encode()])


DEFAULT = "ws://127.0.0.1:8765"
_ADDRESS = re.compile(r"ws://(\[[0-9a-fA-F:]+\]|[^:/\[\]]+)(?::(\d{1,5}))?/?")


class FoxgloveServer:
    """Server of messages for Foxglove, a context manager.

    `address`: URL for viewers, as ``ws://127.0.0.1:8765``; port 0: any free port; `pace`: clock that the
    viewer's buttons for pause and speed control; `span`: first and last time of the recording [s];
    without it there are no such buttons.

    Raises `OptionError`: the address is invalid; `ServiceError`: the address cannot be bound;
    `MissingExtraError`: `foxglove-sdk` is not installed.
    """

    def __init__(
        self,
        address: str = DEFAULT,
        pace: PlaybackClock | None = None,
        span: tuple[float, float] | None = None,
    ) -> None:
        found = _ADDRESS.fullmatch(address)
        if found is None or int(found[2] or 8765) > 65535:
            raise OptionError(
                f"foxglove: {address!r} is not a valid address; give one such as {DEFAULT}."
            )
        try:
            import foxglove
        except ImportError as error:
            raise MissingExtraError(
                'Foxglove needs the extra `foxglove`: pip install "placegraph[foxglove]".'
            ) from error
        self._foxglove, self._context = foxglove, foxglove.Context()
        self._host = found[1]
        self._channels: dict[str, Any] = {}
        self._latched: dict[str, tuple[bytes, int]] = {}
        player = None if pace is None or span is None else (pace, span)
        times = None if span is None else (nanoseconds(span[0]), nanoseconds(span[1]))
        listener: Any = _ViewerListener(self, player)
        try:
            self.server = foxglove.start_server(
                name="placegraph", host=found[1].strip("[]"), port=int(found[2] or 8765),
                context=self._context, server_listener=listener,
                playback_time_range=times if player else None,
            )  # fmt: skip
        except (OSError, RuntimeError) as error:
            raise ServiceError(
                f"The server cannot listen at {address}: {error}; choose another port."
            ) from error

    @property
    def address(self) -> str:
        """URL for viewers."""
        return f"ws://{self._host}:{self.server.port}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.server.stop()

    def write(self, message: Message) -> None:
        """Send a message; latched ones are sent again to later viewers. Raises as `message.cdr`."""
        topic, data, stamp = "/" + message.topic, cdr(message), nanoseconds(message.stamp)
        if topic not in self._channels:
            schema = self._foxglove.Schema(
                name=message.type, encoding="ros2msg", data=definition(message.type).encode()
            )
            self._channels[topic] = self._foxglove.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )
        if message.latched:
            self._latched[topic] = data, stamp
        self._channels[topic].log(data, log_time=stamp)

    def resend(self, topic: str) -> None:
        """Send the latched message of a topic again."""
        if topic in self._latched:
            data, stamp = self._latched[topic]
            self._channels[topic].log(data, log_time=stamp)


class _ViewerListener:
    """Listener for requests of viewers (`foxglove.websocket.ServerListener`)."""

    def __init__(
        self, server: FoxgloveServer, player: tuple[PlaybackClock, tuple[float, float]] | None
    ) -> None:
        self._server, self._player = server, player

    def on_subscribe(self, client: Any, channel: Any) -> None:  # noqa: ANN401, ARG002  # foxglove's
        """Send latched messages to a new subscriber."""
        self._server.resend(channel.topic)

    def on_playback_control_request(self, request: Any) -> Any:  # noqa: ANN401  # foxglove's
        """Pause, resume or change the speed; seeking is not supported."""
        from foxglove.websocket import PlaybackCommand, PlaybackState, PlaybackStatus

        if self._player is None:
            return None
        pace, _ = self._player
        paused = request.playback_command == PlaybackCommand.Pause
        pace.set(
            speed=request.playback_speed if request.playback_speed > 0 else None, paused=paused
        )
        status = PlaybackStatus.Paused if paused else PlaybackStatus.Playing
        return PlaybackState(
            status, nanoseconds(pace.now), pace.speed, did_seek=False, request_id=request.request_id
        )
