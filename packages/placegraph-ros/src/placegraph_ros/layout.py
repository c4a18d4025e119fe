"""The layout by which Foxglove (and Lichtblick) shows what localization says."""

from __future__ import annotations

import json
from importlib.resources import files
from os import PathLike
from pathlib import Path
from typing import Any

from placegraph.core.files import write_file
from placegraph_io.ros.containers import open_bag
from placegraph_io.ros.topics import chosen_views, info_names, views_of

_IMAGE = "/localization/image"


def layout(bag: str | PathLike[str] | None = None) -> dict[str, Any]:
    """Layout as Foxglove imports it; its image is the bag's colours where the bag holds some.

    Raises `InputError` where the bag is none, `MissingExtraError` without `rosbags`.
    """
    text = files("placegraph_ros").joinpath("layout.json").read_text("utf-8")
    content: dict[str, Any] = json.loads(text)
    found = None if bag is None else open_bag(Path(bag))
    views = [] if found is None else [v for v in views_of(found) if v.kind in {"colour", "grey"}]
    if found is None or not views or any(view.topic.name == _IMAGE for view in views):
        return content
    colour, _ = chosen_views(found, views, None, None, with_depth=False)
    infos = [name for name in info_names(colour) if name in found.topics]
    shown = content["configById"]["Image!placegraph"]["imageMode"]
    shown["imageTopic"] = colour.topic.name
    shown["calibrationTopic"] = infos[0] if infos else ""
    return content


def write_layout(bag: str | PathLike[str]) -> Path:
    """Write the layout of a bag beside it, as BAG.layout.json; raises as `layout`, or `MapError`."""
    path = Path(f"{bag}.layout.json")
    return write_file(path, [json.dumps(layout(bag), indent=2).encode()])
