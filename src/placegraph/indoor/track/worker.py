"""Images are looked at one after the other, and looked up beside that, by threads or at once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.threads import count_processors, limit_threads
from placegraph.errors import OptionError
from placegraph.indoor.track.odometry import JUMP
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from threading import Condition

    from placegraph.indoor.track.belief import Belief
    from placegraph.indoor.track.follower import Follower, FrameResult, Relocalization, Relocalized


class Inline(Executor):
    """Does at once, and in the caller's thread, what it is given."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401
        """Do it."""
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done


class Worker:
    """Brings images to a follower, its questions to maps, and what both say to a belief.

    Of images that come too fast the newest is looked at. At most one job looks at images, and one
    looks frames up; `changed` guards the belief and all that is here.
    """

    def __init__(
        self, follower: Follower, belief: Belief, changed: Condition, background: bool | Executor
    ) -> None:
        self.dropped = 0
        self.told: Counter[str] = Counter()
        self._follower, self._belief, self._changed = follower, belief, changed
        self._own = not isinstance(background, Executor)
        self._executor = background if isinstance(background, Executor) else Inline()
        if background is True:
            self._executor = ThreadPoolExecutor(2, thread_name_prefix="placegraph-live")
        self._seen = -np.inf
        self._heard = belief.epoch
        self._inbox: Frame | None = None
        self._answer: Relocalized | None = None
        self._busy = self._searching = False
        self._failed: BaseException | None = None

    def begin(self) -> None:
        """Images of before odometry began anew are of no use; lock held."""
        self.dropped += self._inbox is not None
        self._inbox, self._seen = None, -np.inf

    def is_late(self, frame: Frame) -> bool:
        """Whether a newer image has come already; one much older says that the clock was set back."""
        return bool(self._seen - JUMP <= frame.stamp <= self._seen)

    def take(self, frame: Frame) -> bool:
        """Keep an image, and say whether somebody has to be sent to `work` at it; lock held."""
        self._seen = frame.stamp
        self.dropped += self._inbox is not None
        self._inbox = frame
        idle, self._busy = not self._busy, True
        return idle

    def send(self) -> None:
        """Have images looked at; without the lock."""
        self._executor.submit(self._work)

    def wait(self) -> None:
        """Wait until there is nothing left to look at, or up; lock held."""
        self._changed.wait_for(lambda: self._failed or not (self._busy or self._searching))
        self.check()

    def check(self) -> None:
        """Raise what ended it; lock held."""
        if self._failed is not None:
            raise self._failed

    def close(self) -> None:
        """End threads; without the lock."""
        with self._changed:
            self._inbox = None
            self._failed = self._failed or OptionError("The tracker is closed; make another.")
            self._changed.notify_all()
        if self._own:
            self._executor.shutdown(wait=True, cancel_futures=True)

    def _work(self) -> None:
        """Look at images, and take answers over, until there is none left."""
        looked = False
        try:
            while True:
                with self._changed:
                    epoch, frame, found = self._belief.epoch, self._next(), self._answer
                    self._answer = None
                    if looked and (frame is not None or found is None):  # it has told what it does
                        self.told[self._belief.status.name] += 1
                        looked = False
                    if frame is None and found is None:
                        self._busy = False
                        self._changed.notify_all()
                        return
                    if epoch != self._heard:
                        self._heard, found = epoch, None
                        self._follower.begin(self._belief.near)
                if found is not None:
                    self._publish(epoch, self._follower.hear(found))
                if frame is not None:
                    self._publish(epoch, self._follower.look(frame))
                    self._ask(epoch)
                    looked = True
        except BaseException as error:  # noqa: BLE001  # told to who calls next
            self._fail(error)

    def _next(self) -> Frame | None:
        """The image to look at, with odometry of its time; lock held."""
        frame, self._inbox = self._inbox, None
        if frame is None:
            return None
        sample, why = self._belief.placing(frame)
        if sample is not None:
            return replace(frame, odometry=sample.pose)
        self.dropped += 1
        self._belief.carried(why)
        return None

    def _publish(self, epoch: int, said: FrameResult | None) -> None:
        """Tell the belief what an image said, unless all was begun anew meanwhile."""
        with self._changed:
            if said is not None and epoch == self._belief.epoch:
                self._belief.hear(said)

    def _ask(self, epoch: int) -> None:
        """Have frames looked up, where the pose is not known."""
        with self._changed:
            question = None if self._searching else self._follower.question()
            self._searching |= question is not None
        if question is not None:
            self._executor.submit(self._search, epoch, question)

    def _search(self, epoch: int, question: Relocalization) -> None:
        try:
            with limit_threads(
                max(1, count_processors() - 1)
            ):  # a core is left to those that follow
                found = question.asked(self._follower.finder)
        except BaseException as error:  # noqa: BLE001  # told to who calls next
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
