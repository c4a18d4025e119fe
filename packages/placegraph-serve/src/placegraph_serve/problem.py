"""Errors as RFC 9457 has them: what went wrong, how to mend it, and a word for programs."""

from __future__ import annotations

import re
from typing import Any

from placegraph import errors
from placegraph.errors import PlacegraphError, RequestError

MEDIA_TYPE = "application/problem+json"

_KINDS: dict[type[PlacegraphError], tuple[int, str]] = {
    errors.InputError: (400, "The input cannot be read"),
    errors.DescriptionError: (422, "The description cannot be read"),
    errors.OptionError: (422, "An option is out of range"),
    errors.MissingExtraError: (501, "This server lacks an optional dependency"),
    errors.ServiceError: (502, "A service failed"),
    errors.MapError: (503, "A map cannot be used"),
    errors.StoreError: (503, "A vector store cannot be used"),
    errors.GeoPoseError: (409, "There is no pose on Earth"),
    errors.RequestError: (400, "The request is invalid"),
}


def problem(error: Exception) -> dict[str, Any]:
    """The members of a problem of any exception; what is none of ours tells nothing of the inside."""
    if not isinstance(error, PlacegraphError):
        error = RequestError(
            "The server failed on this request; tell its operator.", status=500, code="failed"
        )
    kind = next((k for k in type(error).__mro__ if k in _KINDS), None)
    status, title = _KINDS[kind] if kind else (500, "The request failed")
    code = type(error).__name__.removesuffix("Error").lower()
    out: dict[str, Any] = {}
    if isinstance(error, RequestError):
        status, code = error.status, error.code
        if error.retry_after is not None:
            out["retry_after"] = error.retry_after
    detail = str(error)
    return {
        "type": f"urn:placegraph:problem:{code}",
        "title": title,
        "status": status,
        "detail": detail,
        "mend": mend_of(detail),
        "code": code,
    } | out


def mend_of(detail: str) -> str:
    """Return the advice of a message: the part after the last semicolon, or the last sentence."""
    told = re.split(r"; |(?<=[.?!]) (?=[A-Z])", detail.strip())[-1]
    return told[:1].upper() + told[1:]


def make_request_error(errors: Any, name: str = "body") -> RequestError:  # noqa: ANN401  # pydantic's
    """Return the first error that pydantic found, as a `RequestError`."""
    first = errors[0]
    if first["type"] == "json_invalid":
        why = first["ctx"]["error"]
        return RequestError(f"{name}: not JSON ({why}); send an object.", code="json")
    where = ".".join(str(part) for part in first["loc"] if part not in {"body", "query"})
    if not where:
        return RequestError(
            f"{name}: not a JSON object; send one, as application/json.", status=422, code="fields"
        )
    return RequestError(
        f"{where[:80]}: {first['msg']}; see /docs for the fields.", status=422, code="fields"
    )
