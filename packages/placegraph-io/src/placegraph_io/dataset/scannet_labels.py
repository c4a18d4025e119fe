"""Label images that ScanNet projects into its frames: `instance-filt/`, `label-filt/`.

Pixels of `instance-filt/7.png` are 1 + objectId of the scan's aggregation; those of
`label-filt/7.png` are ids of ScanNet's label table. 0 is nothing in both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame import LabelKind
from placegraph.io.capture.frame_files import Meanings, label_file
from placegraph.io.capture.images import image_size
from placegraph_io.dataset.scannet_files import (
    TABLES,
    find_scan,
    find_table,
    read_aggregation,
    read_label_map,
)

Wanted = Literal["auto", "labels", "instances"] | None
END = ".aggregation.json"
FOLDERS: dict[LabelKind, str] = {"instances": "instance-filt", "labels": "label-filt"}


@dataclass(frozen=True, slots=True)
class LabelImages:
    """Label images of a scan, by number of the frame."""

    files: dict[int, Path] = field(default_factory=dict)
    camera: Camera | None = None
    kind: LabelKind = "labels"
    names: dict[int, str] = field(default_factory=dict)
    known: Meanings | None = None
    notes: tuple[str, ...] = ()
    """Why label images are not used."""

    def reader(self, index: int) -> Callable[[], NDArray[np.int32]] | None:
        """Function that reads a frame's label image; None where it has none."""
        if self.camera is None or index not in self.files:
            return None
        offset = 1 if self.kind == "instances" else 0
        return label_file(self.files[index], self.camera, offset, self.known)


def find_labels(
    folder: Path,
    wanted: Wanted,
    camera: Camera,
    *,
    label_column: str | None = None,
) -> LabelImages:
    """Label images that lie in a scan's folder; "auto" takes instances, else labels, else none.

    They show what the colour images show, whose camera is given. Names of labels are those of a
    column of ScanNet's table, the raw categories if none is given.

    Raises
    ------
    InputError
        What is wanted is not there or cannot be read; labels lack ScanNet's table.
    OptionError
        `wanted` is none of its values; the table has no such column.

    """
    if wanted not in {"auto", "labels", "instances", None}:
        raise OptionError(f"labels is {wanted!r}; it is 'auto', 'labels', 'instances' or None.")
    if wanted is None:
        return LabelImages()
    for kind, name in FOLDERS.items():
        if wanted not in {"auto", kind}:
            continue
        files = numbered(folder / name, (".png",))
        if not files:
            if wanted == kind:
                raise InputError(
                    f"{folder / name} holds no image `0.png`, but labels={kind!r} asks for it; unpack "
                    f"the scan's _2d-{name}.zip there."
                )
            continue
        if kind == "labels" and wanted == "auto" and find_table(folder) is None:
            note = (
                f"{folder / name} is not used: its numbers need ScanNet's {TABLES[0]}, which lies "
                "neither there nor above."
            )
            return LabelImages(notes=(note,))
        size = image_size(next(iter(files.values())))
        view = camera if size == (camera.width, camera.height) else camera.resized(*size)
        names, known = _meanings(folder, kind, label_column)
        return LabelImages(files, view, kind, names, known)
    return LabelImages()


def _meanings(
    folder: Path, kind: LabelKind, column: str | None
) -> tuple[dict[int, str], Meanings | None]:
    """Names by id, and what ids mean."""
    table = find_table(folder)
    labels = read_label_map(table, column or "raw_category") if table else None
    if kind == "instances":
        above = folder.absolute().parent
        files = (find_scan(folder).file(END), above / f"{above.name}{END}")
        groups = next((read_aggregation(file) for file in files if file.is_file()), [])
        said = labels.of_raw if labels and column else {}
        return {group.id: said.get(group.label, group.label) for group in groups}, None
    if labels is None:
        raise InputError(
            f"{folder / FOLDERS[kind]} holds numbers that ScanNet's {TABLES[0]} explains; put it in "
            f"{folder} or above."
        )
    names = dict(labels.of_id)
    return names, Meanings(names, labels.path, 0)


def numbered(folder: Path, endings: tuple[str, ...]) -> dict[int, Path]:
    """Files of a folder whose stem is a number, by it; `InputError` where two have the same."""
    try:
        files = sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}.") from error
    found: dict[int, Path] = {}
    for file in files:
        stem = file.stem
        if file.suffix.lower() not in endings or not (stem.isascii() and stem.isdigit()):
            continue
        if len(stem) > 12:
            raise InputError(f"{file}: {stem[:40]} is no number of a frame; rename it.")
        if int(stem) in found:
            raise InputError(f"{file} and {found[int(stem)].name} are one frame; keep one of them.")
        found[int(stem)] = file
    return dict(sorted(found.items()))
