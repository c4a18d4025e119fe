"""Options of a server: limits of requests, processes and sessions, and who may ask."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from placegraph.core.options import check_options, option


@dataclass(frozen=True, slots=True, kw_only=True)
class ServeOptions:
    """Limits of a server, and who may ask; raises `OptionError` for numbers that are not above 0."""

    sentence_workers: int = option(2, "Processes that read sentences.", minimum=1)
    capture_workers: int = option(1, "Processes that localize images.", minimum=1)
    queue: int = option(
        64,
        "Maximum waiting requests of a kind; more get 503 with `Retry-After`.",
        minimum=1,
    )
    sentence_seconds: float = option(
        15.0,
        "Time limit of a sentence; longer ones get 504, and the process is replaced.",
        unit="s",
        above=0,
    )
    capture_seconds: float = option(
        120.0, "Time limit of images; longer ones get 504.", unit="s", above=0
    )
    head_seconds: float = option(
        20.0,
        "Maximum time for the head of a request to arrive; then the connection is closed.",
        unit="s",
        above=0,
    )
    body_seconds: float = option(
        30.0, "Maximum time for the body to arrive; slower ones get 408.", unit="s", above=0
    )
    text: int = option(2000, "Maximum characters of a description; longer ones get 422.", minimum=1)
    json_bytes: int = option(
        1 << 18,
        "Maximum JSON body without images; larger ones, here and below, get 413.",
        minimum=1,
    )
    body_bytes: int = option(1 << 28, "Maximum body with images or a capture.", minimum=1)
    held_bytes: int = option(1 << 28, "Memory for all JSON bodies being received.", minimum=1)
    image_bytes: int = option(1 << 25, "Maximum image file.", minimum=1)
    pixels: int = option(24_000_000, "Maximum pixels of an image.", minimum=1)
    images: int = option(200, "Maximum images in a request or a capture.", minimum=1)
    unpacked_bytes: int = option(1 << 30, "Maximum size of an unpacked capture.", minimum=1)
    depth: int = option(32, "Maximum nesting of JSON.", minimum=1)
    sessions: int = option(64, "Maximum open sessions; more get 503 with `Retry-After`.", minimum=1)
    client_sessions: int = option(
        4, "Maximum open sessions of one client (address); more get 429.", minimum=1
    )
    session_seconds: float = option(
        600.0, "Time after which an unused session ends.", unit="s", above=0
    )
    sockets: int = option(2000, "Maximum open WebSockets.", minimum=1)
    keys: Path | None = option(
        None, "File of API keys, one per line; without it, no key is needed.", flag="--keys"
    )
    names: tuple[str, ...] = option(
        (),
        "Host name that the server accepts besides addresses and localhost; with keys, all are "
        "accepted. Repeatable.",
        flag="--name",
    )
    same_origin: bool = option(
        False,
        "Refuse pages of other hosts on /api and /reverse, too; if not set, search boxes of any "
        "page may use them.",
        flag="--same-origin",
    )
    log_queries: bool = option(
        False, "Log queries; if not set, nothing about them is stored.", flag="--log-queries"
    )
    scheduler: str | None = option(
        None,
        "Dask scheduler whose workers search worlds in shards, as tcp://host:8786; if not given, "
        "the server searches them.",
        flag="--scheduler",
    )
    memory: str | None = option(
        None,
        "Memory of each process of the server for open shards of worlds, such as 4GB; shards not "
        "used for longest are closed.",
        flag="--memory",
    )

    def __post_init__(self) -> None:
        check_options(self)
