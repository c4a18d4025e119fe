"""Label tables: what the object ids of a mesh are called."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from placegraph.errors import InputError
from placegraph.io.capture.camera import read_json

_IDS = ("id", "objectId", "object_id", "instance_id")
_LABELS = ("label", "class", "category", "class_name")


@dataclass(frozen=True, slots=True)
class Entry:
    """What a table says of one object."""

    label: str
    name: str = ""
    attributes: dict[str, str] = field(default_factory=dict)


def label_table(
    labels: Mapping[str, str] | Mapping[int, str] | str | PathLike[str], scan: str = ""
) -> dict[str, Entry]:
    """Table by object id, of a mapping from id (or name) to label, or of a JSON file.

    The file holds an object `{"3": "chair"}`; or a list `[{"id": 3, "label": "chair", "name": ...}]`;
    or such a list under `objects` (3RScan's `objects.json`, whose `scans` are searched for `scan`)
    or `segGroups` (3RScan's and ScanNet's aggregation). Other entries become attributes.

    Raises
    ------
    InputError
        The file is missing or none of these.

    """
    if not isinstance(labels, str) and hasattr(labels, "items"):
        return {str(key): Entry(str(label)) for key, label in labels.items()}
    path = Path(labels)
    content = read_json(path)
    if isinstance(content, dict) and "scans" in content:
        content = _scan(path, content["scans"], scan)
    if isinstance(content, dict):
        listed = next((content[k] for k in ("objects", "segGroups") if k in content), None)
        if listed is None:
            return {str(key): _plain(path, key, label) for key, label in content.items()}
        content = listed
    if not isinstance(content, list):
        raise InputError(
            f'{path} is no label table; it holds {{"3": "chair"}} or [{{"id": 3, "label": "chair"}}].'
        )
    return dict(_entry(path, row, entry) for row, entry in enumerate(content))


def _scan(path: Path, scans: object, scan: str) -> object:
    if isinstance(scans, list):
        found = [s for s in scans if isinstance(s, dict) and scan in {s.get("scan"), s.get("id")}]
        if len(scans) == 1 or found:
            return (found or scans)[0]
    raise InputError(
        f"{path} holds several scans, none of which is {scan!r}; cut out the right one."
    )


def _plain(path: Path, key: str, label: object) -> Entry:
    if not isinstance(label, str) or not label:
        raise InputError(f"{path}: the label of {key!r} is {str(label)[:40]!r}, not text.")
    return Entry(label)


def _entry(path: Path, row: int, entry: Any) -> tuple[str, Entry]:  # noqa: ANN401  # of a JSON list
    if not isinstance(entry, dict):
        raise InputError(f"{path}: entry {row} is not an object with id and label.")
    id_ = next((entry[k] for k in _IDS if k in entry), None)
    label = next((entry[k] for k in _LABELS if k in entry), None)
    if isinstance(id_, bool) or not isinstance(id_, int | str) or not isinstance(label, str):
        raise InputError(f"{path}: entry {row} lacks an id (number or text) or a label (text).")
    name = entry.get("name")
    attributes = entry.get("attributes")
    return str(id_), Entry(
        label,
        name if isinstance(name, str) else "",
        {str(k): _said(v) for k, v in attributes.items()} if isinstance(attributes, dict) else {},
    )


def _said(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
