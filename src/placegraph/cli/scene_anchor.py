"""`placegraph scene anchor`: where on Earth a scene map stands, written into the map."""

from __future__ import annotations

import json
from dataclasses import replace
from math import degrees, nan, radians, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Option
from placegraph.cli.common import AsJson, Quiet, numbers_of, progress_of, table
from placegraph.cli.scene_options import MapFile
from placegraph.errors import OptionError
from placegraph.io.osm.indoor_osm import parse_levels

if TYPE_CHECKING:
    from placegraph.core.geo import Anchor
    from placegraph.indoor.pose.window import Progress
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.world import AnchorFit

HOW = "Anchor source (one of these)"
TOLD = "Prior knowledge of the place"
UNKNOWN = 50.0
"""A height with a standard deviation above this is called unknown [m]."""

Pairs = Annotated[
    list[str] | None,
    Option(
        "--pair",
        help="X,Y[,Z]=LON,LAT[,H]: point in the map [m], its longitude and latitude [deg] and "
        "height above the ellipsoid [m]; give three or more.",
        panel=HOW,
    ),
]
Pose = Annotated[
    str | None,
    Option(
        help="LON,LAT,HEIGHT,HEADING_DEG: position of the map's origin, and direction of its y "
        "axis, clockwise from north.",
        panel=HOW,
    ),
]


def anchor(
    map_file: MapFile,
    pair: Pairs = None,
    pose: Pose = None,
    accuracy: Annotated[
        str, Option(help="M,DEG: standard deviation of --pose.", panel=TOLD)
    ] = "1,2",
    height: Annotated[
        float | None,
        Option(help="Height of the map's floor above the ellipsoid [m].", panel=TOLD),
    ] = None,
    level: Annotated[
        str, Option(help="OpenStreetMap's level of the map's floor, such as 1.", panel=TOLD)
    ] = "",
    building: Annotated[
        str, Option(help="Name of the building, its address or id (way/12).", panel=TOLD)
    ] = "",
    place: Annotated[
        Path | None,
        Option(
            "--in",
            help="OpenStreetMap extract or .city map: fit the map's outer walls to the footprint "
            "of --building, and keep every alignment that fits. A rough position from "
            "another option usually leaves one.",
            panel=HOW,
        ),
    ] = None,
    capture: Annotated[
        Path | None,
        Option(
            help="Capture whose GPS fixes (fixes.txt, or the EXIF data of its images) locate the "
            "map.",
            panel=HOW,
        ),
    ] = None,
    remove: Annotated[bool, Option("--remove", help="Remove the map's anchor.", panel=HOW)] = False,
    png: Annotated[
        Path | None, Option(help="Write a plan of the anchored map on its building.")
    ] = None,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Map file to write; the map itself if not given.")
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Place a scene map on Earth, and store the anchor in the map.

    Example: placegraph scene anchor flat.scene --pair 0,0=7.4201,43.7301 --pair 8,0=7.4202,43.7301
    --pair 8,6=7.4202,43.73015
    """
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.world import fit_building

    ways = sum((bool(pair), pose is not None, capture is not None))
    if ways + remove > 1 or not (ways or remove or place) or (remove and place):
        raise OptionError(
            "Give exactly one of --pair (three or more), --pose and --capture, optionally "
            "with --in; or only --in; or only --remove."
        )
    if place is not None and not building:
        raise OptionError("--in needs --building; give the name of the building.")
    if level and not parse_levels(level):
        raise OptionError(f"--level is {level!r}; give an OpenStreetMap level, such as 1 or -1.")
    scene = SceneMap.open(map_file)
    with progress_of(hidden=quiet or as_json) as tell:
        fitted = _fit_anchors(scene, pair, pose, accuracy, capture, tell, rough=place is not None)
    if place is not None:
        on = fit_building(scene, place, building, level, prior=next(iter(fitted.anchors), None))
        fitted = on._replace(notes=(*fitted.notes, *on.notes))
    floor = float(scene.floors.min())
    found = tuple(_add_details(a, floor, height, level, building) for a in fitted.anchors)
    notes = list(fitted.notes)
    if any(a.has_covariance and a.covariance[2, 2] > UNKNOWN**2 for a in found):
        notes.append("The map's height is unknown and set to 0 m; give --height.")
    target = out or map_file
    anchored = scene.anchored(*found)
    anchored.save(target)
    if png is not None and found:
        from placegraph.view import draw_anchors

        draw_anchors(anchored, png, fitted.footprints)
    if as_json:
        result = {
            "map": str(target),
            "anchors": [summary(a) for a in found],
            "notes": notes,
        }
        click.echo(json.dumps(result, ensure_ascii=False))
    elif not quiet:
        show(found)
        for note in notes:
            click.echo(note)
        click.echo(f"{target}: {'anchored' if found else 'stands nowhere now'}.")


def _fit_anchors(
    scene: SceneMap,
    pair: list[str] | None,
    pose: str | None,
    accuracy: str,
    capture: Path | None,
    tell: Progress,
    *,
    rough: bool,
) -> AnchorFit:
    """Anchors by pairs, a pose or fixes, whichever is given; else none."""
    from placegraph.io.capture.capture import open_capture
    from placegraph.world import AnchorFit, fit_capture, fit_points

    if pair:
        return fit_points(*zip(*map(_pair, pair), strict=True))
    if pose is not None:
        return AnchorFit((_posed(pose, accuracy),), ())
    if capture is not None:
        return fit_capture(scene, open_capture(capture), rough=rough, progress=tell)
    return AnchorFit((), ())


def summary(anchor: Anchor) -> dict[str, object]:
    """Summarize an anchor in plain numbers and strings."""
    east, north, up, turn = (sqrt(v) for v in anchor.covariance.diagonal())
    worst = max(anchor.residuals, default=None)
    result: dict[str, object] = {
        "longitude": round(anchor.longitude, 8),
        "latitude": round(anchor.latitude, 8),
        "height_m": round(anchor.height, 2) if up < UNKNOWN else None,
        "heading_deg": round(degrees(anchor.heading), 2) % 360,
        "sd_m": [round(v, 3) for v in (east, north, up)] if anchor.has_covariance else None,
        "sd_deg": round(degrees(turn), 3) if anchor.has_covariance else None,
        "probability": round(anchor.probability, 4),
        "building": anchor.building,
        "osm": anchor.osm,
        "level": anchor.level,
        "method": anchor.method,
        "worst_residual_m": None if worst is None else round(worst, 3),
    }
    return result | ({"scene": anchor.scene} if anchor.scene else {})


def show(anchors: tuple[Anchor, ...]) -> None:
    """Print candidates as a table."""
    if not anchors:
        return
    rows = table("probability", "longitude", "latitude", "heading", "off by", "left", "building")
    for a in anchors:
        east, north, _, turn = (sqrt(v) for v in a.covariance.diagonal())
        off = (
            f"{sqrt((east**2 + north**2) / 2):.2f} m, {degrees(turn):.1f}°"
            if a.has_covariance
            else "?"
        )
        left = (
            f"{sqrt(sum(r * r for r in a.residuals) / len(a.residuals)):.2f} m"
            if a.residuals
            else "-"
        )
        where = " ".join(x for x in (a.building, a.osm and f"({a.osm})") if x) or "-"
        rows.add_row(
            f"{a.probability:.0%}", f"{a.longitude:.7f}", f"{a.latitude:.7f}",
            f"{round(degrees(a.heading), 1) % 360:.1f}°", off, left, where,
        )  # fmt: skip
    from placegraph.cli.common import console

    console().print(rows)


def _add_details(
    anchor: Anchor, floor: float, height: float | None, level: str, building: str
) -> Anchor:
    """An anchor with what was said of the place; `height`, `floor`: of the floor [m]."""
    if height is not None:
        covariance = anchor.covariance.copy()
        covariance[2, :] = covariance[:, 2] = 0.0
        covariance[2, 2] = 1.0
        anchor = replace(anchor, height=height - floor, covariance=covariance)
    return replace(anchor, level=level or anchor.level, building=anchor.building or building)


def _posed(text: str, accuracy: str) -> Anchor:
    import numpy as np

    from placegraph.core.geo import Anchor

    mend = "give longitude, latitude, height and heading_deg, such as 7.42,43.73,50,90."
    lon, lat, height, heading = numbers_of(text, "--pose", {4}, mend)
    mend = "give metres and degrees, such as 1,2."
    metres, turn = numbers_of(accuracy, "--accuracy", {2}, mend)
    if min(metres, turn) < 0:
        raise OptionError(f"--accuracy is {accuracy!r}; {mend}")
    spread = np.square([metres, metres, metres, radians(turn)])
    return Anchor(lon, lat, height, radians(heading), np.diag(spread), method="pose")


def _pair(text: str) -> tuple[list[float], list[float]]:
    """Point (3,) and place (3,), heights NaN where they are not given."""
    point, _, place = text.partition("=")
    mend = "give x and y in the map, and longitude and latitude, such as 8,0=7.42,43.73."
    both = [[*numbers_of(side, "--pair", {2, 3}, mend), nan][:3] for side in (point, place)]
    return both[0], both[1]
