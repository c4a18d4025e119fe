"""Errors: one root, typed children, one stable exit code each.

Messages name the file or the field, say what is wrong, and how to mend it.
"""

from typing import ClassVar


class PlacegraphError(Exception):
    """Root of every error placegraph raises on purpose.

    `exit_code` is the exit code of the command line; `docs/conventions.md` has the table.
    """

    exit_code: ClassVar[int] = 1


class InputError(PlacegraphError):
    """An input file is missing, empty, truncated, or of another format than it claims."""

    exit_code = 3


class MapError(PlacegraphError):
    """A map file is foreign, truncated, damaged, newer, of another kind, or cannot be written."""

    exit_code = 4


class MapLockedError(MapError):
    """Another process is writing this map file."""

    exit_code = 5


class DescriptionError(PlacegraphError):
    """A description cannot be read at all: it is empty, too long, or not text."""

    exit_code = 6


class OptionError(PlacegraphError, ValueError):
    """An argument is out of its range, or arguments contradict each other."""

    exit_code = 7


class MissingExtraError(PlacegraphError, ImportError):
    """An optional dependency is not installed; the message names the extra that installs it."""

    exit_code = 8


class ServiceError(PlacegraphError):
    """A service (Overpass, a language model) cannot be reached or answered nonsense."""

    exit_code = 9


class StoreError(PlacegraphError):
    """A vector store is missing, or was made from another map, model or dimension."""

    exit_code = 10


class IncompleteStoreError(StoreError):
    """A vector store's load was begun and not finished; it is never searched."""

    exit_code = 11


class RequestError(PlacegraphError):
    """A server cannot take a request: unknown, forbidden, too large, too many, or cut short."""

    exit_code = 12

    def __init__(
        self,
        message: str,
        *,
        status: int = 400,
        code: str = "request",
        retry_after: int | None = None,
    ) -> None:
        super().__init__(message)
        self.status = status
        """HTTP status code."""
        self.code = code
        """Stable word for programs."""
        self.retry_after = retry_after
        """Seconds to wait before the next request, where that may help."""


class GeoPoseError(PlacegraphError):
    """An estimate has no pose on Earth: nothing was found, or its scene map is not anchored."""

    exit_code = 13
