"""Figures of the epochs of a training, a line of JSON each; read without PyTorch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping
    from os import PathLike

NAME = "curves.jsonl"


def rows_of(folder: str | PathLike[str]) -> list[dict[str, float]]:
    """Figures of the epochs so far; a line that was cut short when a training died is passed over."""
    path = Path(folder) / NAME
    rows: list[dict[str, float]] = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            rows.append(dict(json.loads(line)))
        except (TypeError, ValueError):
            continue
    return rows


def add_row(folder: str | PathLike[str], row: Mapping[str, float]) -> None:
    """Add the figures of an epoch, in the place of older ones of it and of later epochs.

    The file is replaced whole, so that none is ever cut short.
    """
    path = Path(folder) / NAME
    temporary = path.with_suffix(".tmp")
    before = [r for r in rows_of(folder) if r.get("epoch", 0) < row.get("epoch", 1)]
    rows = [*before, dict(row)]
    temporary.write_text("".join(json.dumps(r) + "\n" for r in rows), encoding="utf-8")
    temporary.replace(path)
