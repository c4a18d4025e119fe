"""What a check of a scene map finds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")

Found = tuple[Severity, str, Sequence[str], str]
"""Severity, sentence, ids, mend."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is odd about a map."""

    severity: Severity
    what: str
    """One sentence."""
    objects: tuple[str, ...] = ()
    """Ids of the objects it is about, at most 20; empty where it is about the whole map."""
    mend: str = ""
    """What to do: an option of `placegraph scene build`, or a word about the file."""

    def to_dict(self) -> dict[str, Any]:
        """Plain strings."""
        return {**asdict(self), "objects": list(self.objects)}
