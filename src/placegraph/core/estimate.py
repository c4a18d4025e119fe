"""Estimates of both wings: status, modes, evidence, refinement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from enum import StrEnum
from functools import cached_property, partial
from math import isnan, nan
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import EarthPose
from placegraph.core.geojson import GeoExport, line_geometry, make_feature
from placegraph.core.pickling import HtmlRepr


@dataclass(frozen=True, slots=True)
class ObjectRef:
    """Reference to a map object that supports or contradicts a statement."""

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

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        plain = {"id": self.id, "label": self.label, "name": self.name}
        place = {"longitude": self.longitude, "latitude": self.latitude}
        return plain | {k: v for k, v in place.items() if not isnan(v)}


@dataclass(frozen=True, slots=True)
class Evidence:
    """Support of one statement of the query for one mode, or its opposition."""

    statement: str
    """The statement as it was parsed."""
    verdict: str
    """``for``, ``against`` or ``silent``."""
    weight: float
    """Log-likelihood ratio of the statement at this mode against anywhere [nat]."""
    objects: tuple[ObjectRef, ...] = ()
    """The map objects that fit it best."""
    note: str = ""
    """The contradiction, or why the statement was not used."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        return {
            "statement": self.statement, "verdict": self.verdict, "weight": self.weight,
            "objects": [o.to_dict() for o in self.objects], "note": self.note,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class LazyEvidence:
    """Answer whose evidence is computed at its first use.

    `explain` holds the map; pickled answers carry the evidence instead.
    """

    explain: Callable[[], tuple[Evidence, ...]] = field(default=tuple, repr=False, kw_only=True)
    """Computes the evidence."""

    @cached_property
    def evidence(self) -> tuple[Evidence, ...]:
        """Statements and objects that speak for this answer and against it."""
        return self.explain()

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings; subclasses add their fields."""
        return {"evidence": [e.to_dict() for e in self.evidence]}

    def __repr__(self) -> str:
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.repr}
        shown = (f"{k}={round(v, 7) if isinstance(v, float) else v!r}" for k, v in values.items())
        return f"{type(self).__name__}({', '.join(shown)})"

    def __getstate__(self) -> dict[str, Any]:
        evidence = self.evidence
        return self.__dict__ | {"evidence": evidence, "explain": partial(tuple, evidence)}


class Status(StrEnum):
    """Confidence class of an estimate."""

    OK = "OK"
    """One mode holds most of the probability, and no named object is missing from the map."""
    AMBIGUOUS = "AMBIGUOUS"
    """Several places fit, or the reason names another doubt; ask a question, or use all modes."""
    LOST = "LOST"
    """No place on the map fits better than a place elsewhere, or the query was not understood."""


@dataclass(frozen=True, eq=False, repr=False)
class Place(LazyEvidence):
    """Mode of an outdoor estimate: a position with its probability, covariance and evidence."""

    longitude: float
    latitude: float
    """Degrees, WGS84, as the longitude."""
    probability: float
    """Posterior over the whole city that the place lies within 50 m of this mode; the prior where
    modes are only ranked (`CityEstimate.ranked`)."""
    cell: str
    """Id of the map's cell that holds the mode."""
    covariance: NDArray[np.float64] = field(repr=False)
    """(2, 2) float64, east-north [m^2]."""

    @property
    def spread(self) -> float:
        """Largest standard deviation in any direction [m]."""
        return float(np.linalg.eigvalsh(self.covariance)[-1] ** 0.5)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        return {
            "longitude": self.longitude,
            "latitude": self.latitude,
            "probability": self.probability,
            "cell": self.cell,
            "covariance": self.covariance.tolist(),
            "evidence": [e.to_dict() for e in self.evidence],
        }


@dataclass(frozen=True, eq=False, repr=False)
class PoseMode(LazyEvidence):
    """Mode of an indoor estimate: a pose of the last frame with covariance, probability and evidence."""

    map_from_camera: NDArray[np.float64] = field(repr=False)
    """(4, 4) float64 [m]; camera axes are OpenCV's."""
    pose: NDArray[np.float64]
    """(4,) float64 x, y, z [m], yaw [rad] of the upright camera (`geometry.split_pose`)."""
    covariance: NDArray[np.float64] = field(repr=False)
    """(6, 6) float64 of x, y, z [m] and of a small turn about the map's x, y, z axes [rad], in ROS's
    order: the true pose is exp(turn) @ rotation at position + shift."""
    probability: float
    scene: str
    """Name of the merged scene of the map that holds the pose."""
    scene_from_camera: NDArray[np.float64] = field(repr=False)
    """(4, 4) float64, the pose in that scene's own frame."""
    earth: tuple[EarthPose, ...] = ()
    """Poses on Earth, one a candidate anchor of the map, best first; empty without an anchor."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        x, y, z, yaw = (float(v) for v in self.pose)
        return {
            "x": x, "y": y, "z": z, "yaw_deg": float(np.rad2deg(yaw)),
            "scene": self.scene,
            "probability": self.probability,
            "map_from_camera": self.map_from_camera.tolist(),
            "covariance": self.covariance.tolist(),
            "evidence": [e.to_dict() for e in self.evidence],
            "earth": [pose.to_dict() for pose in self.earth],
        }  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class SceneMode(LazyEvidence):
    """Mode over the scenes of a library: a scene with its probability and evidence."""

    scene: str
    """Its name."""
    probability: float
    """Posterior over all scenes of the library and none of them."""
    score: float
    """Log-likelihood ratio of the query in this scene against anywhere [nat]; under the paper's
    sum (Sec. 4) the sum over frames of the mean best cosine."""
    earth: tuple[EarthPose, ...] = ()
    """Regions on Earth that the scene covers, one a candidate anchor, best first."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        return {
            "scene": self.scene,
            "probability": self.probability,
            "score": self.score,
            "evidence": [e.to_dict() for e in self.evidence],
            "earth": [pose.to_dict() for pose in self.earth],
        }


@dataclass(frozen=True, eq=False)
class Refinement:
    """Refinement of a coarse pose by images and depth (Sec. 3.6), accepted or not."""

    accepted: bool
    """Whether the best mode is the refined pose; otherwise it is the coarse one."""
    reason: str
    """One sentence that says why."""
    coarse: PoseMode
    """Best mode before the refinement."""
    coarse_trajectory: NDArray[np.float64] = field(repr=False)
    """(T, 4, 4) map_from_camera of every frame before the refinement."""
    stats: dict[str, Any] = field(default_factory=dict)
    """Readings and matches used, their fit to both poses, seconds of each stage."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings."""
        return {
            "accepted": self.accepted,
            "reason": self.reason,
            "coarse": self.coarse.to_dict(),
            "stats": self.stats,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Camera correction: estimated calibration relative to that of the capture.

    Pairs are an estimate and its standard deviation.
    """

    focal_factor: tuple[float, float]
    """Factor on fx and fy of the depth images, and of colour images of the same view."""
    depth_scale: tuple[float, float]
    """Factor on depth readings."""
    gravity_turn: NDArray[np.float64]
    """(3,) rotation vector in the camera's axes that corrects gravity [rad]."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers."""
        values = ((f.name, getattr(self, f.name)) for f in fields(self))
        return {n: v.tolist() if isinstance(v, np.ndarray) else list(v) for n, v in values}


@dataclass(frozen=True, slots=True, eq=False)
class PassRecord:
    """Particles of one pass of the filter, for pictures."""

    stride: float
    """Distance between samples of an image [px]."""
    steps: tuple[tuple[int, NDArray[np.float64], NDArray[np.float64]], ...]
    """One a frame: its row in the capture, poses (N, 4) and weights (N,)."""


Mode = TypeVar("Mode", bound=LazyEvidence)


@dataclass(frozen=True, repr=False)
class Estimate(GeoExport, HtmlRepr, Generic[Mode]):
    """Answer to "where am I?"."""

    status: Status
    modes: tuple[Mode, ...]
    """Best first; empty only where nothing on the map could be compared with the query."""
    reason: str
    """One sentence that says why the status is what it is."""
    map: object = field(default=None, compare=False, kw_only=True)
    """Map that answered, for pictures; None where it is unknown, and after pickling."""

    def __repr__(self) -> str:
        best = f", best of {len(self.modes)}: {self.best}" if self.modes else ""
        return f"{type(self).__name__}({self.status}{best}; {self.reason})"

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"map": None}

    @property
    def best(self) -> Mode | None:
        """The first mode, or None where there is none."""
        return self.modes[0] if self.modes else None

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        """Evidence of the best mode."""
        return self.best.evidence if self.best else ()

    @property
    def remainder(self) -> float | None:
        """Probability of other places than the modes; None where the modes are only ranked."""
        shares = [getattr(mode, "probability", 0.0) for mode in self.modes]
        return None if getattr(self, "ranked", False) else max(0.0, 1.0 - sum(shares))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        modes = [m.to_dict() for m in self.modes]
        head = {"status": self.status.name, "reason": self.reason, "remainder": self.remainder}
        return head | {"modes": modes}


@dataclass(frozen=True, repr=False)
class CityEstimate(Estimate[Place]):
    """Estimate of the place in a city that a description was given at."""

    understood: Any = None
    """Parsed query, with the words that were ignored: `outdoor.language.description.Description`;
    None without a text."""
    support: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """(N, 3) float64: longitude, latitude [deg], probability of the posterior's heaviest points."""
    ranked: bool = False
    """Whether modes were only ranked (by cosines, edits); their probability is then the prior's."""
    way: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(N, 2) float64: longitude, latitude [deg] of the way to the best mode, where the text tells one."""
    radius: float = 50.0
    """An `OK` estimate claims that the place lies within this distance of the best mode [m]."""

    def next_question(self, city: Any) -> Any:  # noqa: ANN401  # a CityMap, which lies above
        """Return the `outdoor.search.ask.Question` whose answer is expected to separate the modes best.

        `city` is the `CityMap` that answered. Returns None where no question helps.
        """
        return city.ask(self)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        understood = self.understood.to_dict() if self.understood else None
        way = {"way": self.way.tolist()} if len(self.way) else {}
        return super().to_dict() | {"radius": self.radius, "understood": understood} | way

    def geojson(self) -> dict[str, Any]:
        """Return the features of `GeoExport.geojson`, and the line of kind ``way`` if there is one."""
        collection = super().geojson()
        if len(self.way):
            collection["features"].append(make_feature(line_geometry([self.way]), {"kind": "way"}))
        return collection


@dataclass(frozen=True, repr=False)
class PoseEstimate(Estimate[PoseMode]):
    """Estimate of the poses of a capture's frames in a scene map; modes are poses of the last frame."""

    trajectory: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(T, 4, 4) float64 map_from_camera of every frame used, under the best mode."""
    frames: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(T,) rows of these frames in the capture."""
    stats: dict[str, Any] = field(default_factory=dict)
    """Effort: seconds of each stage, particles, rays."""
    history: tuple[PassRecord, ...] = ()
    """Particles of each pass, where `FilterOptions.record` is set."""
    refinement: Refinement | None = None
    """Refinement of the pose; None where it was off or impossible."""
    calibration: Calibration | None = None
    """Camera correction that this answer includes; None where the camera needed none."""
    diagnostics: object = field(default=None, compare=False)
    """Measurements behind the status (`placegraph.indoor.status.Diagnostics`), for programs."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        return super().to_dict() | {
            "frames": self.frames.tolist(),
            "trajectory": self.trajectory.tolist(),
            "stats": self.stats,
            "refinement": self.refinement.to_dict() if self.refinement else None,
            "calibration": self.calibration.to_dict() if self.calibration else None,
        }


@dataclass(frozen=True, repr=False)
class SceneEstimate(Estimate[SceneMode]):
    """Estimate of the scene of a library that a capture shows or a text describes."""

    elsewhere: float = 0.0
    """Probability of none of the scenes."""
    stats: dict[str, Any] = field(default_factory=dict)
    """Effort: seconds of each stage."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        return super().to_dict() | {"elsewhere": self.elsewhere, "stats": self.stats}
