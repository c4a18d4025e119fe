"""Changes from a map to a later look at the same place: what they are, and their file."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_output
from placegraph.core.geometry import Floats, vector_from_rotation
from placegraph.core.options import check_options, option
from placegraph.errors import InputError, OptionError
from placegraph.indoor.options import USED
from placegraph.io.capture.json_files import read_json


@dataclass(frozen=True, slots=True)
class DiffOptions:
    """Options that say when something counts as changed.

    The defaults were set by hand, from the errors of poses and depth that the shared house and
    office show, and by looking at what was found there; no sweep was made over them.
    """

    least_shift: float = option(
        0.08,
        "Minimum displacement of an object; objects that move less, and turn less than "
        "`least_turn`, count as unmoved.",
        unit="m",
        above=0,
        flag="--least-shift",
    )
    least_turn: float = option(10.0, "Minimum rotation of an object.", unit="deg", above=0)
    reach: float = option(4.0, "Largest distance of a moved object.", unit="m", above=0)
    depth_floor: float = option(
        0.04,
        "Tolerance between a depth reading and the map at 0 m, including errors of map and pose.",
        unit="m",
        above=0,
    )
    depth_slope: float = option(0.015, "Increase of the tolerance per metre of depth.")
    frames: int = option(60, "Maximum number of frames of a capture, spread evenly.", minimum=1)
    least_pixels: int = option(
        100,
        "Minimum number of pixels on an object over all frames, at an image width of at most 320.",
        minimum=1,
    )
    least_frames: int = option(
        3,
        "Minimum number of frames with at least `least_pixels` / 10 on an object; all "
        "frames if there are fewer.",
        minimum=1,
    )
    voxel: float = option(0.05, "Size of the cells that collect new surfaces.", unit="m", above=0)
    least_box: float = option(
        0.08, "Minimum length of the longest side of an object that appeared.", unit="m"
    )
    depth: bool = option(True, "Use depth images.", flag="--depth/--no-depth", panel=USED)
    colour: bool = option(
        True, "Use colours where depth is inconclusive.", flag="--colour/--no-colour", panel=USED
    )
    b_from_a: Floats | None = None
    """(4, 4) rigid [m], from the first map's axes to the second's; estimated if not given."""
    within: float = option(
        0.05, "Maximum distance between identical surfaces of two maps.", unit="m", above=0
    )
    points: int = option(400, "Points per object that are compared between maps.", minimum=1)
    seed: int = option(0, "The same seed gives the same answer.", flag="--seed")

    def __post_init__(self) -> None:
        check_options(self)
        if not (self.depth or self.colour):
            raise OptionError("depth and colour are both off; leave one on.")
        if self.b_from_a is not None:
            from placegraph.indoor.render import check_pose

            object.__setattr__(self, "b_from_a", check_pose(np.asarray(self.b_from_a)))


Kind = Literal["moved", "appeared", "vanished", "relabelled"]
KINDS: tuple[Kind, ...] = get_args(Kind)
VERSION = 1


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Surface of what appeared, in the axes of the first map."""

    vertices: NDArray[np.float64]
    """(V, 3) [m]"""
    triangles: NDArray[np.int64]
    """(T, 3) rows of vertices."""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB"""

    def __post_init__(self) -> None:
        count = len(self.vertices)
        shapes = [a.ndim == 2 and a.shape[1] == 3 for a in (self.vertices, self.triangles)]
        inside = self.triangles.size and 0 <= self.triangles.min() <= self.triangles.max() < count
        if not (all(shapes) and inside and self.colours.shape == self.vertices.shape):
            raise OptionError("piece: its vertices, triangles and colours are inconsistent.")
        if not np.isfinite(self.vertices).all():
            raise OptionError("piece: a vertex is not finite.")

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers; vertices to a tenth of a millimetre."""
        return {
            "vertices": np.round(self.vertices, 4).tolist(),
            "triangles": self.triangles.tolist(),
            "colours": self.colours.tolist(),
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Piece:
        """Undo `to_dict`; raises `OptionError`, or as `numpy.array` does."""
        return cls(
            np.array(data["vertices"], np.float64).reshape(-1, 3),
            np.array(data["triangles"], np.int64).reshape(-1, 3),
            np.array(data["colours"], np.uint8).reshape(-1, 3),
        )

    @classmethod
    def box(cls, low: Floats, high: Floats, colour: NDArray[np.uint8]) -> Piece:
        """Return box (12 triangles, wound outwards) of one colour (3,)."""
        bits = np.array([(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)])
        quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        faces = [corners for a, b, c, d in quads for corners in ((a, b, c), (a, c, d))]
        return cls(np.where(bits, high, low), np.array(faces), np.tile(colour, (8, 1)))


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One object that is not as the map has it. All geometry is in the first map's axes."""

    kind: Kind
    label: str
    """Label in the first map; for appeared objects, in the second map or "unknown"."""
    confidence: float
    """0 to 1, how often such a finding is taken to be right."""
    reason: str
    """Evidence for the change, in words."""
    id: str = ""
    """In the first map; empty for what appeared."""
    name: str = ""
    other: str = ""
    """Id in the second map, where that is a map."""
    after_from_before: Floats | None = None
    """(4, 4) rigid [m], of what moved: where a point of it was, to where it is now."""
    new_label: str = ""
    """New label of a relabelled object."""
    box: Floats | None = None
    """(2, 3) lower and upper corner [m]: where it is now; of what vanished, where it was."""
    piece: Piece | None = field(default=None, repr=False)
    """Surface of what appeared."""
    centre: Floats | None = None
    """(3,) centre of its box before [m], of what moved."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise OptionError(f"kind is {self.kind!r}; choose one of {', '.join(KINDS)}.")
        if not 0.0 <= self.confidence <= 1.0:
            raise OptionError(f"confidence is {self.confidence}; it must be between 0 and 1.")
        for name, shape in (("after_from_before", (4, 4)), ("box", (2, 3)), ("centre", (3,))):
            value = getattr(self, name)
            if value is not None and (value.shape != shape or not np.isfinite(value).all()):
                raise OptionError(f"{name}: give {shape} finite numbers.")
        if self.kind == "moved" and self.after_from_before is None:
            raise OptionError(
                "after_from_before: it is missing, but a moved object needs a motion."
            )
        if self.kind == "appeared" and self.piece is None:
            raise OptionError("piece: it is missing, but an object that appeared needs a surface.")

    @property
    def shift_m(self) -> float:
        """Distance that its middle moved [m]; 0 of what did not."""
        if self.after_from_before is None:
            return 0.0
        middle = np.zeros(3) if self.centre is None else self.centre
        motion = self.after_from_before
        return float(np.linalg.norm(motion[:3, :3] @ middle + motion[:3, 3] - middle))

    @property
    def turn_deg(self) -> float:
        """Angle that it turned, about any axis [deg]; 0 of what did not move."""
        if self.after_from_before is None:
            return 0.0
        vector = vector_from_rotation(self.after_from_before[:3, :3])
        return float(np.degrees(np.linalg.norm(vector)))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings; what is not known is left out."""
        data: dict[str, Any] = {
            "kind": self.kind, "id": self.id, "name": self.name, "label": self.label,
            "confidence": round(self.confidence, 3), "reason": self.reason,
        }  # fmt: skip
        data |= {k: v for k in ("other", "new_label") if (v := getattr(self, k))}
        if self.after_from_before is not None:
            data["shift_m"], data["turn_deg"] = round(self.shift_m, 3), round(self.turn_deg, 2)
            data["after_from_before"] = self.after_from_before.tolist()
        for key in ("box", "centre"):
            value = getattr(self, key)
            if value is not None:
                data[key] = np.round(value, 4).tolist()
        return data | ({"piece": self.piece.to_dict()} if self.piece is not None else {})

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Change:
        """Undo `to_dict`; raises `OptionError`, KeyError, TypeError or ValueError."""
        arrays: dict[str, Any] = {
            key: np.array(data[key], np.float64)
            for key in ("after_from_before", "box", "centre")
            if key in data
        }
        piece = Piece.from_dict(data["piece"]) if "piece" in data else None
        words: dict[str, Any] = {
            key: str(data.get(key, "")) for key in ("id", "name", "other", "new_label")
        }
        return cls(
            kind=data["kind"], label=str(data["label"]), confidence=float(data["confidence"]),
            reason=str(data["reason"]), piece=piece, **words, **arrays,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class SceneDiff:
    """Changes from a map to a later look at the same place."""

    changes: tuple[Change, ...]
    """Surest first."""
    same: tuple[str, ...]
    """Ids of the map's objects that were seen again where they were."""
    unseen: tuple[str, ...]
    """Ids of the map's objects of which the later look shows too little to tell."""
    b_from_a: Floats
    """(4, 4) rigid [m], from the first map's axes to the second's; the identity for a capture."""
    alignment: str
    """Origin of `b_from_a`, and its quality, in words."""
    before: str = ""
    after: str = ""
    """Source of the second map or capture; `before` is that of the first map."""

    def __iter__(self) -> Iterator[Change]:
        return iter(self.changes)

    def __len__(self) -> int:
        return len(self.changes)

    def of(self, kind: Kind) -> list[Change]:
        """Return changes of one kind, surest first."""
        return [change for change in self.changes if change.kind == kind]

    def __repr__(self) -> str:
        counts = Counter(change.kind for change in self.changes)
        said = ", ".join(f"{counts[kind]} {kind}" for kind in KINDS if counts[kind])
        return f"SceneDiff({said or 'nothing changed'}; {len(self.same)} the same, {len(self.unseen)} unseen)"

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, ready for `json.dumps`."""
        return {
            "version": VERSION,
            "before": self.before,
            "after": self.after,
            "alignment": self.alignment,
            "b_from_a": self.b_from_a.tolist(),
            "changes": [change.to_dict() for change in self.changes],
            "same": list(self.same),
            "unseen": list(self.unseen),
        }

    def save(self, path: str | PathLike[str]) -> None:
        """Write the diff as JSON, for `read_diff` and `placegraph scene update`."""
        text = json.dumps(self.to_dict(), ensure_ascii=False)
        write_output(path, f"{text}\n".encode())


def read_diff(path: str | PathLike[str]) -> SceneDiff:
    """Read a diff that `SceneDiff.save` or `placegraph scene diff --json` wrote.

    Raises `InputError` where the file is missing, no JSON, or no such diff.
    """
    path = Path(path)
    data: Any = read_json(path)
    try:
        if data["version"] != VERSION:
            raise ValueError(f"version {data['version']}, but this placegraph reads {VERSION}")  # noqa: TRY301
        return SceneDiff(
            changes=tuple(Change.from_dict(change) for change in data["changes"]),
            same=tuple(map(str, data["same"])),
            unseen=tuple(map(str, data["unseen"])),
            b_from_a=np.array(data["b_from_a"], np.float64).reshape(4, 4),
            alignment=str(data["alignment"]),
            before=str(data["before"]),
            after=str(data["after"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise InputError(
            f"{path} is not output of `placegraph scene diff --json` "
            f"({type(error).__name__}: {error}); create it again."
        ) from error
