"""What trainings of both wings share: PyTorch, the folder they go on from, figures of epochs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from placegraph.core.files import put
from placegraph.errors import InputError, MissingExtraError, OptionError

CURVES = "curves.jsonl"
PLAN = "plan.json"


def torch_or_what_installs_it() -> Any:  # noqa: ANN401  # the module itself, which may not be there
    """PyTorch; `MissingExtraError` where it is not installed."""
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError(
            "PyTorch is not installed; `pip install 'placegraph[learn]'` brings it."
        ) from error
    return torch


def device_named(device: str, *, cuda: bool) -> str:
    """``cpu`` or ``cuda`` for these and ``auto``; `OptionError` where there is no such device."""
    if device == "auto":
        return "cuda" if cuda else "cpu"
    if device == "cuda" and not cuda:
        raise OptionError("PyTorch finds no CUDA device here; choose cpu or auto.")
    if device not in ("cpu", "cuda"):
        raise OptionError(f"device is {device!r}; choose cpu, cuda or auto.")
    return device


def planned(folder: str | PathLike[str], plan: Mapping[str, Any]) -> dict[str, Any]:
    """Make the folder of a training, or find it again; returns its plan as JSON gave it back.

    Raises
    ------
    InputError
        The folder cannot be made or read.
    OptionError
        It holds a training of another plan.

    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        if not (path / PLAN).exists():
            put(
                path / PLAN, json.dumps(plan, indent=1).encode()
            )  # half of it would end all trainings here
        known: dict[str, Any] = json.loads((path / PLAN).read_text(encoding="utf-8"))
    except (OSError, ValueError, InputError) as error:
        raise InputError(f"{path}: no folder to train in ({error}); name another.") from error
    if known != json.loads(json.dumps(plan)):
        raise OptionError(
            f"{path} holds a training with other maps or options; name another folder, or "
            "delete it to begin anew."
        )
    return known


def rows_of(folder: str | PathLike[str]) -> list[dict[str, float]]:
    """Figures of the epochs so far; a line that was cut short when a training died is passed over."""
    path = Path(folder) / CURVES
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
    path = Path(folder) / CURVES
    temporary = path.with_suffix(".tmp")
    before = [r for r in rows_of(folder) if r.get("epoch", 0) < row.get("epoch", 1)]
    rows = [*before, dict(row)]
    temporary.write_text("".join(json.dumps(r) + "\n" for r in rows), encoding="utf-8")
    temporary.replace(path)
