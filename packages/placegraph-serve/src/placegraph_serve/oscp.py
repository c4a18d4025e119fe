"""Requests of the Open AR Cloud's GeoPose protocol, versions 1 and 2, as clients really send them.

Version 1 has one list of readings, each with the `sensorId` of a sensor that says what it is;
version 2 has one list a kind. Camera parameters stand at the reading or at its sensor, timestamps
are milliseconds or ISO 8601, and image bytes are base64, with or without a data URL's head.
"""

from __future__ import annotations

import binascii
import re
from base64 import b64decode
from dataclasses import dataclass, field
from datetime import datetime
from math import isfinite
from typing import Any

import orjson

from placegraph.errors import InputError, RequestError

KINDS = {
    "camera": "cameraReadings",
    "geolocation": "geolocationReadings",
    "accelerometer": "accelerometerReadings",
}
VERSIONS = (1, 2)
_VERSION = re.compile(
    r"application/vnd\.oscp\+json[^,]*?;\s*version\s*=\s*\"?\s*v?(\d+)", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class Asked:
    """What a request tells."""

    id: str
    timestamp: Any
    """As it was sent: milliseconds, or text."""
    version: int
    camera: list[dict[str, Any]] = field(default_factory=list)
    """Readings, oldest first; `params`, `imageOrientation`, `image` (bytes) and `when` are added."""
    geolocation: list[dict[str, Any]] = field(default_factory=list)
    accelerometer: list[dict[str, Any]] = field(default_factory=list)
    poses: list[dict[str, Any]] = field(default_factory=list)
    """Poses of before, oldest first: `position`, `quaternion` and `accuracy` [m]."""


def version_of(accept: str) -> int | None:
    """Version that an Accept header asks for, however it is spaced; None: it does not say.

    Raises `RequestError` (406) for one that is not spoken here.
    """
    found = _VERSION.search(accept)
    if found is None:
        return None
    version = int(found[1])
    if version not in VERSIONS:
        raise RequestError(
            f"Accept: version {version} of the GeoPose protocol is not spoken here; ask for 1.0 or "
            "2.0.",
            status=406,
            code="version",
        )
    return version


def read_request(body: bytes, version: int | None) -> Asked:
    """Read a request; `InputError` names the field that is not what it should be."""
    try:
        told = orjson.loads(body)  # takes no number or text that could not be sent back
    except ValueError as error:
        raise InputError(f"body: not JSON ({error}); send a GeoPose request.") from None
    if not isinstance(told, dict):
        raise InputError("body: no object; send a GeoPose request.")
    readings = told.get("sensorReadings")
    if not isinstance(readings, dict | list):
        raise InputError("sensorReadings: missing, or no list or object; send what was read.")
    version = version or (1 if isinstance(readings, list) else 2)
    sensors = {str(s.get("id")): s for s in _objects(told.get("sensors") or [], "sensors")}
    kinds = _flat(readings, sensors) if isinstance(readings, list) else _by_kind(readings)
    for reading in kinds["camera"]:
        sensor = sensors.get(str(reading.get("sensorId")), {})
        reading["params"] = part(reading, "params") or part(sensor, "params")
        reading["imageOrientation"] = part(reading, "imageOrientation")
        reading["image"] = image_bytes(reading.get("imageBytes") or "")
    camera, geolocation, accelerometer = (
        sorted(kinds[kind], key=lambda r: float(r["when"])) for kind in KINDS
    )
    name, stamp = str(told.get("id") or ""), told.get("timestamp")
    return Asked(name, stamp, version, camera, geolocation, accelerometer, _poses(told))


def image_bytes(text: object) -> bytes:
    """Bytes of base64, of either alphabet, with or without padding and the head of a data URL."""
    if not isinstance(text, str):
        raise InputError("imageBytes: no text; send base64.")
    coded = text.partition(",")[2] if text.startswith("data:") else text
    coded = "".join(coded.split()).translate(str.maketrans("-_", "+/")).rstrip("=")
    try:
        return b64decode(coded + "=" * (-len(coded) % 4), validate=True)
    except (binascii.Error, ValueError) as error:
        raise InputError(f"imageBytes: not base64 ({error}); encode the image anew.") from None


def part(holder: dict[str, Any], name: str) -> dict[str, Any]:
    """An object of an object, empty where there is none; `InputError` where it is something else."""
    value = holder.get(name) or {}
    if not isinstance(value, dict):
        raise InputError(f"{name}: {str(value)[:40]!r} is no object; send one, or leave it out.")
    return value


def number(holder: dict[str, Any], name: str, default: float | None = None) -> float:
    """A finite number of an object; `InputError` where it is none."""
    value = holder.get(name)
    if value is None and default is not None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise InputError(f"{name}: {str(value)[:40]!r} is no number; send one.")
    return float(value)


def _flat(readings: list[Any], sensors: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Readings of version 1 by kind, which their sensors tell, or else what they hold."""
    kinds: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    for outer in _objects(readings, "sensorReadings"):
        inner = outer.get("reading", outer)
        inner = inner[0] if isinstance(inner, list) and inner else inner
        if not isinstance(inner, dict):
            raise InputError("sensorReadings: reading is no object; send what was read.")
        kind = sensors.get(str(outer.get("sensorId")), {}).get("type") or _told(inner)
        if kind in kinds:
            kinds[kind].append({**outer, **inner, "when": _seconds(outer.get("timestamp"))})
    return kinds


def _by_kind(readings: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Readings of version 2."""
    return {
        kind: [
            {**r, "when": _seconds(r.get("timestamp"))}
            for r in _objects(readings.get(name) or [], name)
        ]
        for kind, name in KINDS.items()
    }


def _told(reading: dict[str, Any]) -> str:
    return (
        "camera" if "imageBytes" in reading
        else "geolocation" if "latitude" in reading
        else ""
    )  # fmt: skip


def _poses(told: dict[str, Any]) -> list[dict[str, Any]]:
    poses = []
    for prior in _objects(told.get("priorPoses") or [], "priorPoses"):
        pose, accuracy = prior.get("geopose") or prior.get("pose"), prior.get("accuracy")
        if not isinstance(pose, dict) or not isinstance(pose.get("position"), dict):
            raise InputError("priorPoses: a pose has no position; send a GeoPose.")
        metres = accuracy.get("position") if isinstance(accuracy, dict) else accuracy
        poses.append(
            {
                "position": {n: number(pose["position"], n) for n in ("lon", "lat", "h")},
                "quaternion": pose.get("quaternion"),
                "accuracy": number({"accuracy": metres}, "accuracy", 0.0),
                "when": _seconds(prior.get("timestamp")),
            }
        )
    return sorted(poses, key=lambda p: p["when"])


def _objects(value: object, name: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
        raise InputError(f"{name}: no list of objects; send one.")
    return value


def _seconds(stamp: object) -> float:
    """Seconds since 1970 of milliseconds or ISO 8601; 0 where there is none."""
    if isinstance(stamp, bool) or stamp is None:
        return 0.0
    if isinstance(stamp, int | float) and isfinite(stamp):
        return stamp / 1000.0
    try:
        return datetime.fromisoformat(str(stamp)).timestamp()
    except ValueError as error:
        raise InputError(
            f"timestamp: {str(stamp)[:40]!r} is no time; send milliseconds since 1970."
        ) from error
