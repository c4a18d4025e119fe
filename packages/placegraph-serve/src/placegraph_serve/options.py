"""What a server takes, and how much of it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from placegraph.errors import OptionError


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """Limits of a server, and who may ask; `OptionError` where a number is not greater than 0."""

    sentence_workers: int = 2
    """Processes that read sentences."""
    capture_workers: int = 1
    """Processes that localize images; they hold no sentence up."""
    queue: int = 64
    """Requests that wait for a process of their kind at most; others are told to come again."""
    sentence_seconds: float = 15.0
    """After so long a sentence is given up [s]."""
    capture_seconds: float = 120.0
    """The same of images [s]."""
    head_seconds: float = 20.0
    """A request whose head takes longer to arrive is given up [s]."""
    body_seconds: float = 30.0
    """A body that takes longer to arrive is given up [s]."""
    text: int = 2000
    """Characters of a description."""
    json_bytes: int = 1 << 18
    """Of a JSON body, but for those that carry images."""
    body_bytes: int = 1 << 28
    """Of a body that carries images, or a capture."""
    held_bytes: int = 1 << 28
    """Of all JSON bodies at one time, which are held in memory."""
    image_bytes: int = 1 << 25
    """Of one image."""
    pixels: int = 24_000_000
    """Of one image."""
    images: int = 200
    """In a request, or in a capture."""
    unpacked_bytes: int = 1 << 30
    """Of a capture, unpacked."""
    depth: int = 32
    """Levels of JSON."""
    sessions: int = 64
    """At one time."""
    session_seconds: float = 600.0
    """A session that is not used for so long ends [s]."""
    sockets: int = 2000
    """WebSockets at one time."""
    keys: Path | None = None
    """File with one API key a line; None: everybody may ask."""
    names: tuple[str, ...] = ()
    """Host names that it is asked by, beside addresses and localhost; with `keys`, by any."""
    log_queries: bool = False
    """Whether what is asked is logged."""
    scheduler: str | None = None
    """Address of a Dask scheduler whose workers search worlds in shards; None: the server does it."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in {"keys", "names", "log_queries", "scheduler"} and not value > 0:
                raise OptionError(f"{field.name} is {value}; give a number greater than 0.")
