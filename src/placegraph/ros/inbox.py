"""Between those who bring messages and the one who takes them: it never keeps a robot waiting."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from threading import Condition
from typing import TYPE_CHECKING

from placegraph.formats.ros.packets import Packet
from placegraph.formats.ros.views import IMAGES

if TYPE_CHECKING:
    from placegraph.ros.localizer import Localizer
    from placegraph.ros.message import Message

    Asked = Callable[[Localizer], list[Message]]

NEWEST = 4
"""Images of a topic that wait at most; then the oldest is dropped."""
_MOST = 5000  # other messages
_TICK = 0.02  # seconds after which None is handed out


class Inbox:
    """Takes messages and questions from any thread without waiting, and hands them out in order.

    `dropped` counts images, and others, for which there was no room.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._changed = Condition()
        self._held: deque[Packet | Asked] = deque()
        self._images: Counter[str] = Counter()
        self._closed = False

    def put(self, packet: Packet) -> None:
        """Take a message."""
        with self._changed:
            if packet.type.replace("/msg/", "/") in IMAGES:
                self._images[packet.topic] += 1
                if self._images[packet.topic] > NEWEST:
                    self._drop(packet.topic)
            elif len(self._held) >= _MOST:
                self.dropped += 1
                return
            self._held.append(packet)
            self._changed.notify()

    def ask(self, asked: Asked) -> None:
        """Take what is to be done with the localizer."""
        with self._changed:
            self._held.append(asked)
            self._changed.notify()

    def close(self) -> None:
        """Hand out nothing more."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[Packet | Asked | None]:
        while True:
            with self._changed:
                if not self._held and not self._closed:
                    self._changed.wait(_TICK)
                if self._closed:
                    return
                event = self._held.popleft() if self._held else None
                if isinstance(event, Packet) and event.topic in self._images:
                    self._images[event.topic] -= 1
            yield event

    def _drop(self, topic: str) -> None:
        """Drop the oldest image of a topic."""
        row = next(
            i
            for i, held in enumerate(self._held)
            if isinstance(held, Packet) and held.topic == topic
        )
        del self._held[row]
        self._images[topic] -= 1
        self.dropped += 1
