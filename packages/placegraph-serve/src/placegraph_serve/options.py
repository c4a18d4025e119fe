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
        "Most waiting requests of a kind; beyond it the answer is 503 with `Retry-After`.",
        minimum=1,
    )
    sentence_seconds: float = option(
        15.0,
        "Time limit of a sentence; beyond it 504, and the process is replaced.",
        unit="s",
        above=0,
    )
    capture_seconds: float = option(120.0, "The same for images.", unit="s", above=0)
    head_seconds: float = option(
        20.0,
        "Time for the head of a request to arrive; then the connection is closed.",
        unit="s",
        above=0,
    )
    body_seconds: float = option(30.0, "Time for the body to arrive; then 408.", unit="s", above=0)
    text: int = option(2000, "Most characters of a description; beyond it 422.", minimum=1)
    json_bytes: int = option(
        1 << 18, "Largest JSON body without images; beyond it, and those below, 413.", minimum=1
    )
    body_bytes: int = option(1 << 28, "Largest body with images or a capture.", minimum=1)
    held_bytes: int = option(1 << 28, "Memory for all JSON bodies at one time.", minimum=1)
    image_bytes: int = option(1 << 25, "Largest image file.", minimum=1)
    pixels: int = option(24_000_000, "Most pixels of an image.", minimum=1)
    images: int = option(200, "Most images in a request or a capture.", minimum=1)
    unpacked_bytes: int = option(1 << 30, "Largest capture, unpacked.", minimum=1)
    depth: int = option(32, "Most levels of JSON.", minimum=1)
    sessions: int = option(64, "Most open sessions; beyond it 503 with `Retry-After`.", minimum=1)
    session_seconds: float = option(600.0, "Life of an unused session.", unit="s", above=0)
    sockets: int = option(2000, "Most open WebSockets.", minimum=1)
    keys: Path | None = option(
        None, "File of API keys, one per line; without it, no key is needed.", flag="--keys"
    )
    names: tuple[str, ...] = option(
        (),
        "Host name of the server, beside addresses and localhost; with keys, any will do. Repeatable.",
        flag="--name",
    )
    log_queries: bool = option(
        False, "Log queries; otherwise nothing about them is stored.", flag="--log-queries"
    )
    scheduler: str | None = option(
        None,
        "Dask scheduler whose workers search worlds in shards, as tcp://host:8786; the server itself if "
        "not given.",
        flag="--scheduler",
    )

    def __post_init__(self) -> None:
        check_options(self)
