"""The one loop of all faces: what happens comes from a source, and messages go to whoever carries them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Protocol

from placegraph.io.capture.frame import Frame
from placegraph_ros.message import Message
from placegraph_ros.options import Summary

if TYPE_CHECKING:
    from placegraph_io.ros.stream import Fault, Packet
    from placegraph_ros.localizer import Localizer

    Asked = Callable[[Localizer], list[Message]]


class Sink(Protocol):
    """What carries messages: a bag, a recording, a viewer, a node."""

    def write(self, message: Message) -> None:
        """Take a message."""


def run(
    happenings: Iterable[Packet | Fault | Frame | Asked | None],
    localizer: Localizer,
    sinks: Sequence[Sink],
    told: Callable[[Localizer], None] | None = None,
) -> Summary:
    """Localize what happens until it ends, and close the localizer.

    Parameters
    ----------
    happenings
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

        for event in happenings:
            send(event(localizer) if callable(event) else localizer.take(event))
        send(localizer.finish())
        return localizer.summary
