"""What a statement of a query, or a measurement, says of one answer, and by which objects."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from math import isnan, nan
from typing import Any


@dataclass(frozen=True, slots=True)
class ObjectRef:
    """A map object that served, or spoke against, a statement."""

    id: str
    """OpenStreetMap's own id, such as ``way/4711``, or the object's id in a scene map."""
    label: str
    """Tag, such as ``amenity=cafe``, or label."""
    name: str
    """Name, or an empty string."""
    longitude: float = nan
    """Degrees, WGS84; not a number indoors."""
    latitude: float = nan
    """Degrees, WGS84; not a number indoors."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one statement of the query said about one mode."""

    statement: str
    """The statement as it was understood."""
    verdict: str
    """``for``, ``against`` or ``silent``."""
    weight: float
    """Log-likelihood ratio of the statement at this mode against anywhere [nat]."""
    objects: tuple[ObjectRef, ...] = ()
    """The map objects that served it best."""
    note: str = ""
    """What spoke against it, or why it was not used."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        plain = _plain(self)
        plain["objects"] = [
            {k: v for k, v in _plain(o).items() if not (isinstance(v, float) and isnan(v))}
            for o in self.objects
        ]
        return plain


def _plain(given: Evidence | ObjectRef) -> dict[str, Any]:
    """Fields and values: a tenth of the time of `dataclasses.asdict`, which copies deeply."""
    return {field.name: getattr(given, field.name) for field in fields(given)}


@dataclass(frozen=True, eq=False)
class Explained:
    """An answer whose evidence is found when it is first asked for.

    What finds it holds the map. Sent to another process, the answer takes the evidence along
    instead.
    """

    explain: Callable[[], tuple[Evidence, ...]] = field(default=tuple, repr=False, kw_only=True)
    """Finds the evidence."""

    @cached_property
    def evidence(self) -> tuple[Evidence, ...]:
        """What speaks for this answer and against it, and which objects; found when first asked for."""
        return self.explain()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings; what else an answer says, it adds."""
        return {"evidence": [e.to_dict() for e in self.evidence]}

    def __getstate__(self) -> dict[str, Any]:
        found = self.evidence
        return self.__dict__ | {"evidence": found, "explain": partial(tuple, found)}
