"""What the services that OSMnx asks have in common: who asks, and answers that are none."""

from __future__ import annotations

import html
import re
from typing import Any

from placegraph.errors import MissingExtraError, ServiceError

MEND = {
    "Nominatim": "Try again in some minutes.",
    "Overpass": "Try again in some minutes, or name another server (--overpass-url).",
}


def osmnx_or_what_installs_it() -> Any:  # noqa: ANN401 - the module itself, which may not be there
    """OSMnx; `MissingExtraError` where it is not installed."""
    try:
        import osmnx as ox
    except ImportError as error:
        raise MissingExtraError(
            "OSMnx is not installed; `pip install 'placegraph[osmnx]'` brings it."
        ) from error
    return ox


def agent(ox: Any) -> str:  # noqa: ANN401 - the module osmnx
    """Say who asks, as both services want it."""
    return f"placegraph, {ox.settings.http_user_agent}"


def accept(response: Any, service: str) -> None:  # noqa: ANN401 - requests, loaded late
    """Raise `ServiceError` where the service did not answer what was asked."""
    if not response.ok:
        said = gist(response.content[:4096])
        raise ServiceError(
            f"{service} answered {response.status_code} {response.reason}"
            f"{f' ({said})' if said else ''}. {MEND[service]}"
        )


def unreachable(service: str, error: Exception) -> ServiceError:
    """Error of a service that nobody answers for."""
    return ServiceError(
        f"{service} cannot be reached, or broke off: {gist(str(error).encode())}. "
        "Check the network and the server's address, and try again."
    )


def nonsense(service: str, said: bytes) -> ServiceError:
    """Error of a service that answers something else."""
    return ServiceError(
        f"{service} answered something else than was asked for: {gist(said) or 'nothing'}. "
        f"{MEND[service]}"
    )


def gist(text: bytes, most: int = 200) -> str:
    """Return what a page or message says, on one line, without its markup."""
    plain = re.sub(r"<(style|script|title)\b.*?</\1>|<[^>]*>", " ", text.decode(errors="replace"),
                   flags=re.DOTALL)  # fmt: skip
    line = " ".join(html.unescape(plain).split()).rstrip(".")
    return line if len(line) <= most else line[: most - 1] + "…"
