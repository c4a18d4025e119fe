"""What the routes of a server share: maps, limits, lanes, sessions, counts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from starlette.responses import JSONResponse, Response

from placegraph import kept
from placegraph.serve.lanes import Lane
from placegraph.serve.metrics import Metrics
from placegraph.serve.problem import MEDIA_TYPE
from placegraph.serve.sessions import Sessions
from placegraph.serve.worker import Setting

if TYPE_CHECKING:
    from placegraph.serve.options import ServeOptions
    from placegraph.serve.places import Places


class Server:
    """Maps, limits, lanes, sessions, counts."""

    def __init__(self, places: Places, options: ServeOptions) -> None:
        self.places, self.options = places, options
        self.metrics = Metrics()
        folder = kept.FOLDERS.chosen
        words = Setting(places.paths, options, "warm", folder)
        frames = Setting(places.paths, options, "look", folder)
        seconds = options.sentence_seconds, options.capture_seconds
        self.sentences = Lane("sentences", options.sentence_workers, seconds[0], words)
        self.captures = Lane("captures", options.capture_workers, seconds[1], frames)
        self.steps = Lane("steps", 1, seconds[1], frames)
        self.sessions = Sessions(self.steps, options)

    @property
    def lanes(self) -> tuple[Lane, ...]:
        """All lanes."""
        return self.sentences, self.captures, self.steps

    async def ask(self, lane: Lane, verb: str, asked: dict[str, Any]) -> Response:
        """Answer of a lane as a response."""
        return response_of(*await lane.ask(verb, asked))

    def now(self) -> dict[str, float]:
        """What is so at this moment, for `Metrics.text`."""
        told: dict[str, float] = {"sessions": len(self.sessions)}
        for lane in self.lanes:
            kind = f'{{lane="{lane.name}"}}'
            told |= {f"waiting{kind}": lane.waiting, f"running{kind}": lane.running}
            told[f"answered_total{kind}"] = lane.answered
            told[f"workers_replaced_total{kind}"] = lane.replaced
        return told


def response_of(body: bytes | None, trouble: dict[str, Any] | None) -> Response:
    """A body, or a problem, as a response."""
    if trouble is None:
        return Response(body, media_type="application/json")
    headers = {"Retry-After": str(trouble["retry_after"])} if "retry_after" in trouble else {}
    return JSONResponse(trouble, trouble["status"], headers, media_type=MEDIA_TYPE)
