"""The one result type of both wings: status, ranked modes, evidence."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.outdoor.ask import Question
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.description import Description


class Status(StrEnum):
    """How far an estimate may be trusted."""

    OK = "OK"
    """One mode holds most of the probability."""
    AMBIGUOUS = "AMBIGUOUS"
    """Several places fit; ask a question, or look at all modes."""
    LOST = "LOST"
    """Nothing fits better than being somewhere else, or nothing was understood."""


@dataclass(frozen=True, slots=True)
class ObjectRef:
    """A map object that served, or spoke against, a statement."""

    id: str
    """OpenStreetMap's own id, such as ``way/4711``."""
    label: str
    """Tag, such as ``amenity=cafe``."""
    name: str
    """Name, or an empty string."""
    longitude: float
    """Degrees, WGS84."""
    latitude: float
    """Degrees, WGS84."""


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


def _no_evidence() -> tuple[Evidence, ...]:
    return ()


@dataclass(frozen=True, eq=False)
class Place:
    """A mode of an outdoor estimate: a position, how sure it is, and why."""

    longitude: float
    """Degrees, WGS84."""
    latitude: float
    """Degrees, WGS84."""
    probability: float
    """Probability over the whole city that the place lies within 50 m of this mode."""
    cell: str
    """Id of the map's cell that holds the mode."""
    covariance: NDArray[np.float64]
    """(2, 2) float64, east-north [m^2]."""
    explain: Callable[[], tuple[Evidence, ...]] = field(default=_no_evidence, repr=False)
    """Finds the evidence."""

    @cached_property
    def evidence(self) -> tuple[Evidence, ...]:
        """What each statement says of this place; found when first asked for."""
        return self.explain()


@dataclass(frozen=True)
class Estimate:
    """Answer to "where am I?"."""

    status: Status
    modes: tuple[Place, ...]
    """Best first. Empty only where nothing on the map could be compared with the query."""
    reason: str
    """One sentence: why this status."""
    understood: Description | None = None
    """What was understood of the query, and what was ignored."""
    support: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """(N, 3) float64: longitude, latitude [deg], probability; the posterior's heaviest points."""

    @property
    def best(self) -> Place | None:
        """The first mode, or None where there is none."""
        return self.modes[0] if self.modes else None

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        """Evidence of the best mode."""
        return self.best.evidence if self.best else ()

    def next_question(self, city: CityMap) -> Question | None:
        """Question whose answer is expected to tell the modes apart best; None where none would."""
        from placegraph.outdoor.ask import next_question

        return next_question(self, city)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        return {
            "status": self.status.name,
            "reason": self.reason,
            "modes": [
                {
                    "longitude": m.longitude,
                    "latitude": m.latitude,
                    "probability": m.probability,
                    "cell": m.cell,
                    "covariance": m.covariance.tolist(),
                    "evidence": [asdict(e) for e in m.evidence],
                }
                for m in self.modes
            ],
            "understood": self.understood.to_dict() if self.understood else None,
        }
