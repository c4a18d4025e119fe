"""The scenes of a library by name: what is known of each, and its map when it is needed."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence, PoseEstimate, SceneEstimate
from placegraph.core.files import real_path, regular
from placegraph.core.geo import EarthPose
from placegraph.core.geometry import Camera
from placegraph.core.mapfile import MapFile, pack_strings, read_map, sound, write_map
from placegraph.core.pickling import Shown
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError
from placegraph.indoor.encode import ENCODERS, Encoder, encoder
from placegraph.indoor.language import Sentence, TextIndex
from placegraph.indoor.language.index import Columns
from placegraph.indoor.library.answer import Many, evidence, search
from placegraph.indoor.library.localize import localize
from placegraph.indoor.library.search import Scores, SearchOptions, scores
from placegraph.indoor.library.signature import (
    GRAIN,
    KIND,
    VERSION,
    Index,
    Signature,
    columns,
    decoys,
    signature_of,
    signatures_in,
)
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.estimate import whereabouts
from placegraph.indoor.scene_map import SceneMap
from placegraph.indoor.track.live import LiveTracker
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.library.search import Query

_OPEN = 8  # maps kept open
_MERGED = 8  # of those localized in, with their tables


@dataclass(frozen=True, eq=False)
class Entry:
    """One scene of a library."""

    signature: Signature
    path: Path | None
    """Map file; None where the map is only in memory."""
    digest: str = ""
    """SHA-256 of the file."""
    earth: tuple[EarthPose, ...] = ()
    """Where its map stands on Earth: one a candidate, likeliest first, for somebody anywhere in it."""


class Scenes:
    """Scenes by name, each with a signature of kilobytes; maps are opened when they are needed.

    Parameters
    ----------
    encoders
        What scenes and captures are compared by: names, such as ``labels``, or encoders. A capture
        needs something for one of them only.
    height
        Of the cameras above the floor [m]; `options.STANDING` if not given.

    Raises
    ------
    OptionError
        There is no encoder, or none of that name, or two are alike.

    """

    def __init__(
        self,
        encoders: str | Encoder | Sequence[str | Encoder] = ("labels", "appearance"),
        *,
        height: float | None = None,
    ) -> None:
        given = [encoders] if isinstance(encoders, str | Encoder) else list(encoders)
        self.encoders = tuple(encoder(e) if isinstance(e, str) else e for e in given)
        keys = [e.key for e in self.encoders]
        if not keys or len(set(keys)) < len(keys):
            raise OptionError(
                f"encoders are {', '.join(keys) or 'none'}; give at least one, each once."
            )
        self.height = height
        self._entries: dict[str, Entry] = {}
        self._index: Index | None = None
        self._own: Index | None = None
        self._texts: TextIndex | None = None
        self.usual: Columns | None = None
        """Rooms that tell what is usual in a text, of a part of more scenes; its own if None."""
        self._open: OrderedDict[str, SceneMap] = OrderedDict()
        self._merged: OrderedDict[Hashable, Scene] = OrderedDict()

    def add(
        self, name: str, scene: SceneMap | str | os.PathLike[str], captures: Sequence[Capture] = ()
    ) -> None:
        """Add a map, or the map of a file.

        Parameters
        ----------
        name
            Of the scene; no slash, and not yet taken.
        scene
            A map, kept in memory, or its file, opened again when it is needed.
        captures
            Images of it, where an encoder needs some; their odometry is map_from_camera.

        Raises
        ------
        OptionError
            The name is none, or taken; the scene says nothing to the encoders (`signature_of`).
        InputError, MapError
            The file is no sound scene map.

        """
        if not name or "/" in name:
            raise OptionError(f"name is {name!r}; give one without a slash.")
        if name in self._entries:
            raise OptionError(f"{name!r} is taken; remove it first, or take another name.")
        path = None if isinstance(scene, SceneMap) else Path(scene)
        opened = scene if isinstance(scene, SceneMap) else SceneMap.open(scene)
        signature = signature_of(opened, self.encoders, captures, self.height)
        digest = "" if path is None else digest_of(path)
        self.insert(name, Entry(signature, path, digest, whereabouts(opened)))
        if path is None:
            self._open[name] = opened

    def insert(self, name: str, entry: Entry, scene: SceneMap | None = None) -> None:
        """Add a scene whose signature is known already; and its map, where that is open."""
        self._entries[name] = entry
        if scene is not None:
            self._open[name] = scene
        self._index = self._own = self._texts = None

    def remove(self, name: str) -> None:
        """Take a scene out; its file stays. Raises `OptionError` where there is none."""
        self.entry(name)
        del self._entries[name]
        self._open.pop(name, None)
        self._merged.clear()
        self._index = self._own = self._texts = None

    def entry(self, name: str) -> Entry:
        """Signature and file of a scene; `OptionError` where there is none of this name."""
        if name not in self._entries:
            raise OptionError(f"{name!r} is no scene of this library; it has {self._some()}.")
        return self._entries[name]

    def scene(self, name: str) -> SceneMap:
        """Map of a scene, opened where it is not open yet.

        Raises
        ------
        OptionError
            There is no scene of this name.
        InputError, MapError
            Its file is gone, is no sound map, or another one than was added.

        """
        entry = self.entry(name)
        if name in self._open:
            self._open.move_to_end(name)
            return self._open[name]
        if entry.path is None:
            raise InputError(
                f"{name}: the library knows its signature alone, and no map of it; add it again by "
                "its file."
            )
        if not entry.path.exists():
            raise InputError(
                f"{entry.path}: the map of {name!r} is not there; bring it back, or remove the scene."
            )
        opened = SceneMap.open(entry.path)
        if digest_of(entry.path) != entry.digest:
            raise MapError(
                f"{entry.path} is another map than was added as {name!r}; remove the scene and add "
                "it again."
            )
        self._open[name] = opened
        while sum(self._entries[n].path is not None for n in self._open) > _OPEN:
            self._open.pop(next(n for n in self._open if self._entries[n].path is not None))
        return opened

    def kept(self, key: Hashable, merge: Callable[[], Scene]) -> Scene:
        """A map merged of some scenes: one of the last eight, else made anew."""
        if key not in self._merged:
            self._merged[key] = merge()
        self._merged.move_to_end(key)
        while len(self._merged) > _MERGED:
            self._merged.popitem(last=False)
        return self._merged[key]

    def __getstate__(self) -> dict[str, Any]:
        """Signatures, and the maps that no file holds; the rest is opened and derived again."""
        held = {n: m for n, m in self._open.items() if self._entries[n].path is None}
        derived: dict[str, Any] = {
            "_index": None,
            "_own": None,
            "_texts": None,
            "_merged": OrderedDict(),
        }
        return self.__dict__ | derived | {"_open": OrderedDict(held)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all scenes, in the order in which they came."""
        return tuple(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __repr__(self) -> str:
        encoders = ", ".join(e.name for e in self.encoders)
        return f"{type(self).__name__}({len(self)} scenes by {encoders})"

    def _some(self) -> str:
        names = ", ".join(list(self._entries)[:5])
        return names + (", ..." if len(self) > 5 else "") if names else "none at all"

    missing = 0
    """Scenes that cannot be searched: of shards alone."""
    notes: tuple[str, ...] = ()

    def name(self, row: int) -> str:
        """Name of a scene by its row."""
        return self.names[row]

    def earth(self, row: int) -> tuple[EarthPose, ...]:
        """Where it stands."""
        return self.entry(self.names[row]).earth

    def compared(self, query: Query, options: SearchOptions) -> Scores:
        """What frames say of all scenes, and of the homes beside them."""
        return scores(self.own_index if options.method == "cosines" else self.index, query, options)

    def said(self, sentence: Sentence) -> NDArray[np.float64]:
        """What a text says of each scene (n,) against the average of them [nat]."""
        return self.texts.scores(sentence)

    def evidence(
        self, row: int, asked: Query | Sentence, options: SearchOptions
    ) -> tuple[Evidence, ...]:
        """What speaks for a scene."""
        return evidence(self, self.names[row], asked, options)

    def holding(self, rows: Sequence[int]) -> Scenes:  # noqa: ARG002  # all are here
        """Library, with their maps, of some scenes at least: itself."""
        return self

    @property
    def index(self) -> Index:
        """All signatures side by side, and those of `decoys`; `OptionError` where the library is empty."""
        if not self._entries:
            raise OptionError("The library is empty: add a scene before you search it.")
        if self._index is None:
            signatures = [e.signature for e in self._entries.values()] + decoys(self.encoders)
            self._index = Index.of(signatures, [e.key for e in self.encoders])
        return self._index

    @property
    def own_index(self) -> Index:
        """The scenes alone, without the homes beside them."""
        if self._own is None:
            scenes = self.index.owner < len(self)
            self._own = self.index.subset(np.flatnonzero(scenes))
        return self._own

    @property
    def texts(self) -> TextIndex:
        """All graphs as texts ask for them; `OptionError` where the library is empty."""
        if self._texts is None:
            _ = self.index
            self._texts = TextIndex()
            for entry in self._entries.values():
                self._texts.add_units(entry.signature.described)
        return self._texts


def digest_of(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal; `InputError` where they cannot be read."""
    try:
        return hashlib.sha256(regular(path).read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(
            f"{path} cannot be read any more ({error.strerror}); bring it back."
        ) from error


Progress = Callable[[str, int, int], None]


SUFFIX = ".scene"
"""Of the maps in a folder."""


class SceneCollection:
    """What a library is asked, whether it was read or is mapped in shards."""

    def search(
        self,
        query: str | Capture | Sequence[Frame],
        *,
        frames: slice | Sequence[int] | None = None,
        description: str | None = None,
        options: SearchOptions | None = None,
        most: int = 10,
    ) -> SceneEstimate:
        """Which scenes a capture was taken in, or a text describes, likeliest first.

        Parameters
        ----------
        query
            A capture or frames in order of time; or a text: "a kitchen with two sinks".
        frames
            Which frames; all if not given.
        description
            What somebody says of the place where a capture was taken.
        options
            `SearchOptions`; what measured best if not given. Of captures only.
        most
            Modes returned at most.

        Raises
        ------
        OptionError
            The library is empty; the query has nothing that can be compared, or understood.
        InputError
            An image is broken.

        """
        return search(
            cast("Many", self),
            query,
            frames=frames,
            description=description,
            options=options,
            most=most,
        )

    def localize(self, capture: Capture | Sequence[Frame], **options: Any) -> PoseEstimate:  # noqa: ANN401
        """Scene and pose of a capture: retrieval, then a pose in each of the best, one by one.

        Parameters, result and errors: `placegraph.indoor.library.localize.localize`.
        """
        return localize(cast("Many", self), capture, **options)


class SceneLibrary(SceneCollection, Shown, Scenes):
    """Scenes by name, and the question in which of them something is.

    Made empty, opened from a file that `save` wrote, or from a folder of scene maps; parameters
    and errors as of `Scenes`.
    """

    def live(self, camera: Camera | None = None, **options: Any) -> LiveTracker:  # noqa: ANN401
        """The map and the pose in it at any time, as frames come.

        Options and errors: `placegraph.indoor.track.live.LiveTracker`.
        """
        from placegraph.indoor.track.live import LiveTracker

        return LiveTracker(self, camera, **options)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all signatures and the places of the maps into one file (atomically).

        Maps are named relative to the file, so that both can be moved together. Raises `MapError`
        where it cannot be written, `OptionError` where a map is only in memory or there is none.
        """
        if not len(self):
            raise OptionError("The library is empty: add a scene before you save it.")
        entries = [self.entry(name) for name in self]
        nowhere = [n for n, e in zip(self, entries, strict=True) if e.path is None]
        if nowhere:
            raise OptionError(
                f"{nowhere[0]!r} is a map in memory; save it, and add it to the library by its file."
            )
        folder = real_path(path).parent
        places = [os.path.relpath(real_path(e.path), folder) for e in entries if e.path is not None]
        signatures = [e.signature for e in entries]
        meta = {
            "encoders": [{"name": e.name, "key": e.key} for e in self.encoders],
            "digests": [e.digest for e in entries],
            "earth": [[pose.to_dict() for pose in e.earth] for e in entries],
            "height": self.height,
            "grain": GRAIN,
        }
        arrays = {"names": pack_strings(self.names), "paths": pack_strings(places)}
        arrays |= columns(signatures, [e.key for e in self.encoders])
        write_map(path, KIND, VERSION, meta, arrays)

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        encoders: str | Encoder | Sequence[str | Encoder] | None = None,
        progress: Progress | None = None,
    ) -> SceneLibrary:
        """Open a library's file, or make a library of a folder of scene maps.

        Parameters
        ----------
        path
            File that `save` wrote, or folder with ``*.scene``.
        encoders
            Encoders of a folder's library, or of a file's, where they cannot be made by name alone.
        progress
            Is told how many maps of a folder have been read.

        Raises
        ------
        InputError, MapError
            It is no such thing; a folder holds no map; encoders are other than the file's.

        """
        if Path(path).is_dir():
            return cls._of_folder(Path(path), encoders, progress)
        return cls._of_file(path, encoders)

    @classmethod
    def _of_file(
        cls, path: str | os.PathLike[str], encoders: str | Encoder | Sequence[str | Encoder] | None
    ) -> SceneLibrary:
        file = read_map(path, KIND, VERSION)
        made = encoders_of(file, encoders)
        with sound(path, "Make the library again."):
            library = cls(made, height=file.meta["height"])
            names, places = file.strings("names"), file.strings("paths")
            digests = [str(digest) for digest in file.meta["digests"]]
            poses = [
                tuple(map(EarthPose.from_dict, found))
                for found in file.meta.get("earth", [[]] * len(names))
            ]
            signatures = signatures_in(file, [e.key for e in library.encoders])
            folder = real_path(path).parent
            for name, place, signature, digest, earth in zip(
                names, places, signatures, digests, poses, strict=True
            ):
                at = Path(os.path.normpath(folder / place))
                library.insert(name, Entry(signature, at, digest, earth))
        return library

    @classmethod
    def _of_folder(
        cls,
        folder: Path,
        encoders: str | Encoder | Sequence[str | Encoder] | None,
        progress: Progress | None,
    ) -> SceneLibrary:
        paths = sorted(folder.glob(f"*{SUFFIX}"))
        if not paths:
            raise InputError(
                f"{folder} holds no scene map (*{SUFFIX}); build some with `placegraph scene build`."
            )
        library = cls() if encoders is None else cls(encoders)
        for i, path in enumerate(paths):
            if progress:
                progress("reading maps", i, len(paths))
            library.add(path.stem, path)
        if progress:
            progress("reading maps", len(paths), len(paths))
        return library


def library_of(maps: Mapping[str, SceneMap], **options: Any) -> SceneLibrary:  # noqa: ANN401
    """Library of maps in memory; options are those of `SceneLibrary`."""
    library = SceneLibrary(**options)
    for name, scene in maps.items():
        library.add(name, scene)
    return library


def encoders_of(
    file: MapFile, given: str | Encoder | Sequence[str | Encoder] | None
) -> list[Encoder]:
    """Encoders of a file, made by name or given; `MapError` where these are others."""
    known = [] if given is None else [given] if isinstance(given, str | Encoder) else list(given)
    made = {e.key: e for e in (encoder(g) if isinstance(g, str) else g for g in known)}
    try:
        wanted = [(str(e["name"]), str(e["key"])) for e in file.meta["encoders"]]
    except (KeyError, TypeError) as error:
        raise MapError(f"{file.header.path}: names no encoders. Make the library again.") from error
    out = [made.get(key) or _by_name(name, key) for name, key in wanted]
    for found, (_, key) in zip(out, wanted, strict=True):
        if found is None or (made and not made.keys() & {k for _, k in wanted}):
            here = ", ".join(made) or (found.key if found else "nothing that makes such vectors")
            raise MapError(
                f"{file.header.path} was encoded by {key}, and here is {here}: open it with the "
                "encoder that it was made with (encoders=..., or --encoder and --weights), or make "
                "the library again."
            )
    return [e for e in out if e is not None]


def _by_name(name: str, key: str) -> Encoder | None:
    """Encoder that can be made by its name alone, and has this key; None where there is none."""
    try:
        made = encoder(name) if name in ENCODERS else None
    except (OptionError, MissingExtraError):  # it needs weights, or what is not installed
        return None
    return made if made is not None and made.key == key else None
