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
from placegraph.core.geojson import GeoExport
from placegraph.core.pickling import HtmlRepr


@dataclass(frozen=True, slots=True)
class ObjectRef:
    """A map object that served, or spoke against, a statement."""

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

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        plain = _plain(self)
        plain["objects"] = [
            {k: v for k, v in _plain(o).items() if not (isinstance(v, float) and isnan(v))}
            for o in self.objects
        ]
        return plain


def _plain(given: Evidence | ObjectRef) -> dict[str, Any]:
    """Fields and values: a tenth of the time of `dataclasses.asdict`, which copies deeply."""
    return {field.name: getattr(given, field.name) for field in fields(given)}


@dataclass(frozen=True, eq=False)
class Explained:
    """An answer whose evidence is found when it is first asked for.

    What finds it holds the map. Sent to another process, the answer takes the evidence along
    instead.
    """

    explain: Callable[[], tuple[Evidence, ...]] = field(default=tuple, repr=False, kw_only=True)
    """Finds the evidence."""

    @cached_property
    def evidence(self) -> tuple[Evidence, ...]:
        """What speaks for this answer and against it, and which objects; found when first asked for."""
        return self.explain()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings; what else an answer says, it adds."""
        return {"evidence": [e.to_dict() for e in self.evidence]}

    def __getstate__(self) -> dict[str, Any]:
        found = self.evidence
        return self.__dict__ | {"evidence": found, "explain": partial(tuple, found)}


class Status(StrEnum):
    """How far an estimate may be trusted."""

    OK = "OK"
    """One mode holds most of the probability, and nothing that was named is missing from the map."""
    AMBIGUOUS = "AMBIGUOUS"
    """Several places fit, or the reason names what stands in the way; ask, or look at all modes."""
    LOST = "LOST"
    """Nothing fits better than being somewhere else, or nothing was understood."""


@dataclass(frozen=True, eq=False)
class Place(Explained):
    """A mode of an outdoor estimate: a position, how sure it is, and why."""

    longitude: float
    latitude: float
    """Degrees, WGS84, as the longitude."""
    probability: float
    """Probability over the whole city that the place lies within 50 m of this mode; where places
    are only ranked (`CityEstimate.ranked`) that of the prior."""
    cell: str
    """Id of the map's cell that holds the mode."""
    covariance: NDArray[np.float64] = field(repr=False)
    """(2, 2) float64, east-north [m^2]."""

    @property
    def spread(self) -> float:
        """Standard deviation in the direction in which the place is least sure [m]."""
        return float(np.linalg.eigvalsh(self.covariance)[-1] ** 0.5)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return {
            "longitude": self.longitude,
            "latitude": self.latitude,
            "probability": self.probability,
            "cell": self.cell,
            "covariance": self.covariance.tolist(),
            "evidence": [e.to_dict() for e in self.evidence],
        }


@dataclass(frozen=True, eq=False)
class PoseMode(Explained):
    """A mode of an indoor estimate: a pose of the last frame, how sure it is, and why."""

    map_from_camera: NDArray[np.float64] = field(repr=False)
    """(4, 4) float64 [m]; camera axes are OpenCV's."""
    pose: NDArray[np.float64]
    """(4,) float64 x, y, z [m], yaw [rad] of the camera stood upright (`geometry.split_pose`)."""
    covariance: NDArray[np.float64] = field(repr=False)
    """(6, 6) float64 of x, y, z [m] and of a small turn about the map's x, y, z axes [rad], which
    is ROS's order: the true pose is exp(turn) @ rotation at position + shift."""
    probability: float
    scene: str
    """Which of the merged scenes of the map it lies in."""
    scene_from_camera: NDArray[np.float64] = field(repr=False)
    """(4, 4) float64, the pose in that scene's own frame; of a plain map the same."""
    earth: tuple[EarthPose, ...] = ()
    """Where on Earth: one a candidate of the map's anchor, best first; none: it is not anchored."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
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


@dataclass(frozen=True, eq=False)
class SceneMode(Explained):
    """A scene of a library, how sure it is, and why."""

    scene: str
    """Its name."""
    probability: float
    """Against all other scenes of the library, and against being in none of them."""
    score: float
    """Log-likelihood ratio of the query in this scene against anywhere [nat]; under the paper's
    sum (Sec. 4) the sum over frames of the mean best cosine."""
    earth: tuple[EarthPose, ...] = ()
    """Where on Earth, for somebody anywhere in it: as of a `PoseMode`."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return {
            "scene": self.scene,
            "probability": self.probability,
            "score": self.score,
            "evidence": [e.to_dict() for e in self.evidence],
            "earth": [pose.to_dict() for pose in self.earth],
        }


@dataclass(frozen=True, eq=False)
class Refinement:
    """What became of a coarse pose when it was fitted to images and depth (Sec. 3.6)."""

    accepted: bool
    """Whether the best mode is the refined pose; if not, it is the coarse one."""
    reason: str
    """One sentence: why."""
    coarse: PoseMode
    """The best mode before."""
    coarse_trajectory: NDArray[np.float64] = field(repr=False)
    """(T, 4, 4) map_from_camera of every frame used before."""
    stats: dict[str, Any] = field(default_factory=dict)
    """Readings and matches used, what they said of both poses, seconds of each stage."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings."""
        return {
            "accepted": self.accepted,
            "reason": self.reason,
            "coarse": self.coarse.to_dict(),
            "stats": self.stats,
        }


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """How a camera differs from what its capture says of it; pairs are values and their deviations."""

    focal_factor: tuple[float, float]
    """On fx and fy of the colour images."""
    depth_focal_factor: tuple[float, float]
    """The same of the depth images."""
    depth_scale: tuple[float, float]
    """On depth readings."""
    camera_from_depth: NDArray[np.float64]
    """(4, 4) pose of the depth camera in the axes of the colour camera [m]."""
    gravity_turn: NDArray[np.float64]
    """(3,) rotation vector in the axes of the camera that mends gravity [rad]."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        pairs = ("focal_factor", "depth_focal_factor", "depth_scale")
        plain = {name: list(getattr(self, name)) for name in pairs}
        arrays = {
            name: getattr(self, name).tolist() for name in ("camera_from_depth", "gravity_turn")
        }
        return plain | arrays


@dataclass(frozen=True, slots=True, eq=False)
class PassRecord:
    """Particles of one pass of the filter, for pictures."""

    stride: float
    """Pixels between samples."""
    steps: tuple[tuple[int, NDArray[np.float64], NDArray[np.float64]], ...]
    """For each frame its row in the capture, poses (N, 4) and weights (N,)."""


Mode = TypeVar("Mode", bound=Explained)


@dataclass(frozen=True, repr=False)
class Estimate(GeoExport, HtmlRepr, Generic[Mode]):
    """Answer to "where am I?"."""

    status: Status
    modes: tuple[Mode, ...]
    """Best first. Empty only where nothing on the map could be compared with the query."""
    reason: str
    """One sentence: why this status."""
    map: object = field(default=None, compare=False, kw_only=True)
    """What it was found on, for pictures; None where nobody said, and in another process."""

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

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        modes = [m.to_dict() for m in self.modes]
        return {"status": self.status.name, "reason": self.reason, "modes": modes}


@dataclass(frozen=True, repr=False)
class CityEstimate(Estimate[Place]):
    """Where in a city a description was given."""

    understood: Any = None
    """`placegraph.outdoor.language.description.Description`: the query as it was parsed, and what was
    ignored; None where nothing was said."""
    support: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """(N, 3) float64: longitude, latitude [deg], probability; the posterior's heaviest points."""
    ranked: bool = False
    """Whether modes were only ranked (by cosines, edits); their probability is then the prior's."""

    def next_question(self, city: Any) -> Any:  # noqa: ANN401  # a CityMap, which lies above
        """Return the question whose answer is expected to tell the modes apart best.

        `city` is the `CityMap` that answered. Returns a `placegraph.outdoor.search.ask.Question`;
        None where no question would.
        """
        return city.ask(self)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        understood = self.understood.to_dict() if self.understood else None
        return super().to_dict() | {"understood": understood}


@dataclass(frozen=True, repr=False)
class PoseEstimate(Estimate[PoseMode]):
    """Where in a scene map the last frame of a capture was taken, and all others."""

    trajectory: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """(T, 4, 4) float64 map_from_camera of every frame used, under the best mode."""
    frames: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(T,) rows of these frames in the capture."""
    stats: dict[str, Any] = field(default_factory=dict)
    """What it took: seconds of each stage, particles, rays."""
    history: tuple[PassRecord, ...] = ()
    """Particles of each pass, where `FilterOptions.record` asked for them."""
    refinement: Refinement | None = None
    """How the pose was refined; None where nobody asked for it or there was nothing to refine."""
    calibration: Calibration | None = None
    """What was found to be wrong with the camera, and mended for this answer; None: nothing."""
    diagnostics: object = field(default=None, compare=False)
    """Measurements that the status rests on (`placegraph.indoor.status.Diagnostics`), for code; people
    read `stats`."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        return super().to_dict() | {
            "frames": self.frames.tolist(),
            "trajectory": self.trajectory.tolist(),
            "stats": self.stats,
            "refinement": self.refinement.to_dict() if self.refinement else None,
            "calibration": self.calibration.to_dict() if self.calibration else None,
        }


@dataclass(frozen=True, repr=False)
class SceneEstimate(Estimate[SceneMode]):
    """Which scenes of a library a capture was taken in, or a text describes."""

    elsewhere: float = 0.0
    """Probability that it is none of them."""
    stats: dict[str, Any] = field(default_factory=dict)
    """What it took: seconds of each stage."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        return super().to_dict() | {"elsewhere": self.elsewhere, "stats": self.stats}
