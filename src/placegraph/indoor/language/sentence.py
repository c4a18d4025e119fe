"""What a sentence says, before any map is looked at: things are mentioned, statements relate them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from placegraph.estimate import Evidence
    from placegraph.graph import SceneGraph
    from placegraph.indoor.language.index import TextIndex
    from placegraph.indoor.language.score import Score
    from placegraph.indoor.likelihood.visibility import VisibilityTable
    from placegraph.indoor.map.scene import Scene
    from placegraph.language.check import Ignored


ME = -1
"""Stands for the speaker where a mention could stand."""


class Kind(StrEnum):
    """Kinds of statements; all but ROOM, HOLDS and RELATED are about where the speaker is."""

    ROOM = "room"
    """This is such a room, or one is in it: "in the kitchen", "a kitchen with ..."."""
    HOLDS = "holds"
    """The thing is here, in sight: "there is a plant", "with two sinks"."""
    NEAR = "near"
    """The thing is near me, or `distance` away: "next to the sofa"."""
    FAR = "far"
    """"far from the door"."""
    BETWEEN = "between"
    """I am between the things: "between the table and the fridge"."""
    TOWARDS = "towards"
    """The thing lies at `bearing` from where I look: "facing the window", "behind me"."""
    RELATED = "related"
    """The first thing is `relation` of the second: "a plant on the table"."""


@dataclass(frozen=True, slots=True)
class Mention:
    """A thing spoken of."""

    words: str
    """As written: "two brown chairs"."""
    label: str
    """What it is called, without what counts or describes it: "chairs"."""
    count: int | None = None
    """How many, where said: "two sinks"."""
    several: bool = False
    """"some chairs", "many books": more than one."""
    attributes: tuple[str, ...] = ()
    """Colours, materials, sizes: "brown"."""
    negated: bool = False
    """"no plant", "without a desk"."""
    room: str = ""
    """Kind of room that the label names (`rooms.toml`), or empty."""


@dataclass(frozen=True, slots=True)
class Statement:
    """What is said of one or two things."""

    kind: Kind
    things: tuple[int, ...]
    """Rows of `Sentence.mentions`."""
    relation: str = ""
    """Of RELATED, by a name that `relation_words` knows; of NEAR how: "in front of", "on"."""
    bearing: float = 0.0
    """Of TOWARDS: direction of the thing from where the speaker looks [rad, left is +pi/2]."""
    wide: bool = False
    """Of TOWARDS: anywhere in the picture ("I see a plant"), not straight there."""
    distance: float | None = None
    """How far, where said [m]."""
    negated: bool = False
    certainty: float = 1.0
    """In (0, 1]: lower for what is said to be "maybe" so."""
    text: str = ""
    """The words it was read from."""


@dataclass(frozen=True)
class Sentence:
    """What was understood of a text, and what was not."""

    text: str
    mentions: tuple[Mention, ...] = ()
    statements: tuple[Statement, ...] = ()
    ignored: tuple[Ignored, ...] = ()

    def prior(self, scene: Scene, table: VisibilityTable) -> NDArray[np.float32]:
        """Log prior (K, A) float32 over the table's positions and headings a * STEP [nat].

        Against the uniform: its exponential has the mean 1 for each statement, so it can be added
        to what images say. Zero where nothing was said that the map could serve (`unused`).
        """
        from placegraph.indoor.language.prior import prior

        return prior(self, scene, table)

    def unused(self, scene: Scene) -> tuple[Ignored, ...]:
        """What of the sentence says nothing on this map, and why: things it does not have."""
        from placegraph.indoor.language.prior import unused

        return unused(self, scene)

    def evidence(
        self, scene: Scene, table: VisibilityTable, pose: ArrayLike
    ) -> tuple[Evidence, ...]:
        """What each statement says of a pose (4,) x, y, z [m], yaw [rad] on a map."""
        from placegraph.indoor.language.prior import evidence

        return evidence(self, scene, table, pose)

    def score(
        self, graph: SceneGraph, rooms: Sequence[str] = (), library: TextIndex | None = None
    ) -> Score:
        """How well a scene answers the text, as a log-likelihood ratio against an average scene.

        Parameters
        ----------
        graph
            Scene graph of a room, or of a home.
        rooms
            (N,) name or number of the room of each object, empty where unknown, as attribute `room`
            of a map's objects; without, relations "same room" say what is together.
        library
            Index that says how rare things are; else they are as rare as in homes (`rooms.toml`).

        Raises
        ------
        OptionError
            There is not one room for each object.

        """
        from placegraph.indoor.language.score import score

        return score(self, graph, rooms, library)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        return asdict(self)
