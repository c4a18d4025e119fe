"""Libraries: scene maps by name, and the question in which of them a capture was taken."""

from __future__ import annotations

import hashlib
import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular, resolve_path
from placegraph.core.geo import EarthPose
from placegraph.core.mapfile import MapFile, check_contents, pack_strings, read_map, write_map
from placegraph.core.pickling import HtmlRepr
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError
from placegraph.indoor.encode import ENCODERS, Encoder, encoder
from placegraph.indoor.language import Sentence, TextIndex, score
from placegraph.indoor.language.index import Columns
from placegraph.indoor.library.search import (
    Query,
    SceneCollection,
    Scores,
    SearchOptions,
    explain_frames,
    score_scenes,
)
from placegraph.indoor.library.signature import (
    GRAIN,
    KIND,
    VERSION,
    Index,
    Signature,
    compute_signature,
    load_decoys,
    pack_signatures,
    read_signatures,
)
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.estimate import possible_earth_poses
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture

if TYPE_CHECKING:
    from placegraph.core.estimate import Evidence
    from placegraph.core.geometry import Camera
    from placegraph.indoor.track.live import LiveTracker

Progress = Callable[[str, int, int], None]
Encoders = str | Encoder | Sequence[str | Encoder]

SUFFIX = ".scene"  # Of the maps in a folder
_MAX_OPEN = 8  # maps kept open
_MAX_MERGED = 8  # of those localized in, with their tables


@dataclass(frozen=True, eq=False)
class Entry:
    """One scene of a library."""

    signature: Signature
    path: Path | None  # Map file; None where the map is only in memory
    digest: str = ""  # SHA-256 of the file
    earth: tuple[EarthPose, ...] = ()
    """Candidate poses of the map on Earth, likeliest first; each covers all of the map."""


class SceneLibrary(SceneCollection, HtmlRepr):
    """Scenes by name, each with a signature of kilobytes; maps are opened when they are needed.

    Made empty, opened from a file that `save` wrote, or from a folder of scene maps.

    Parameters
    ----------
    encoders
        By which scenes and captures are compared: names, such as ``labels``, or encoders. A capture
        needs something for one of them only.
    height
        Of the cameras above the floor [m]; `options.STANDING` if not given.

    Raises
    ------
    OptionError
        There is no encoder, or none of that name, or two are alike.

    """

    missing = 0
    notes = ()

    def __init__(
        self, encoders: Encoders = ("labels", "appearance"), *, height: float | None = None
    ) -> None:
        given = [encoders] if isinstance(encoders, str | Encoder) else list(encoders)
        self.encoders = tuple(encoder(e) if isinstance(e, str) else e for e in given)
        keys = [e.key for e in self.encoders]
        if not keys or len(set(keys)) < len(keys):
            raise OptionError(
                f"encoders are {', '.join(keys) or 'none'}; give at least one, without repetitions."
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
            The name is none, or taken; the scene says nothing to the encoders (`compute_signature`).
        InputError, MapError
            The file is no sound scene map.

        """
        if not name or "/" in name:
            raise OptionError(f"name is {name!r}; give a name without a slash.")
        if name in self._entries:
            raise OptionError(
                f"A scene named {name!r} exists already; remove it first, or choose another name."
            )
        path = None if isinstance(scene, SceneMap) else Path(scene)
        opened = scene if isinstance(scene, SceneMap) else SceneMap.open(scene)
        signature = compute_signature(opened, self.encoders, captures, self.height)
        digest = "" if path is None else hash_file(path)
        self.insert(name, Entry(signature, path, digest, possible_earth_poses(opened)))
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
        """Return signature and file of a scene; `OptionError` where there is none of this name."""
        if name not in self._entries:
            names = ", ".join(list(self._entries)[:5]) + (", ..." if len(self) > 5 else "")
            raise OptionError(
                f"{name!r} is not a scene of this library; its scenes are {names or 'none at all'}."
            )
        return self._entries[name]

    def scene(self, name: str) -> SceneMap:
        """Return the map of a scene, opened where it is not open yet.

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
                f"{name}: the library stores only the signature of the scene, not the path of its "
                "map; add the map file again."
            )
        if not entry.path.exists():
            raise InputError(
                f"{entry.path}: the map of {name!r} is missing; restore it, or remove the scene."
            )
        opened = SceneMap.open(entry.path)
        if hash_file(entry.path) != entry.digest:
            raise MapError(
                f"{entry.path} is not the map that was added as {name!r}; remove the scene "
                "and add it again."
            )
        self._open[name] = opened
        while sum(self._entries[n].path is not None for n in self._open) > _MAX_OPEN:
            self._open.pop(next(n for n in self._open if self._entries[n].path is not None))
        return opened

    def cache_merged(self, key: Hashable, merge: Callable[[], Scene]) -> Scene:
        """Return a map merged of some scenes: one of the last eight, else made anew."""
        if key not in self._merged:
            self._merged[key] = merge()
        self._merged.move_to_end(key)
        while len(self._merged) > _MAX_MERGED:
            self._merged.popitem(last=False)
        return self._merged[key]

    def __getstate__(self) -> dict[str, Any]:
        """Return signatures, and the maps that no file holds; the rest is opened and derived again."""
        in_memory = OrderedDict(
            (n, m) for n, m in self._open.items() if self._entries[n].path is None
        )
        derived: dict[str, Any] = {"_index": None, "_own": None, "_texts": None}
        return self.__dict__ | derived | {"_merged": OrderedDict(), "_open": in_memory}

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

    def name(self, row: int) -> str:
        """Return the name of a scene by its row."""
        return self.names[row]

    def earth(self, row: int) -> tuple[EarthPose, ...]:
        """Return the anchor of a scene on Earth."""
        return self.entry(self.names[row]).earth

    def score_frames(self, query: Query, options: SearchOptions) -> Scores:
        """Score all scenes, and the homes beside them, by frames."""
        index = self.own_index if options.method == "cosines" else self.index
        return score_scenes(index, query, options)

    def score_text(self, sentence: Sentence) -> NDArray[np.float64]:
        """Return the log-likelihood ratio of a text for each scene (n,), against their average."""
        return self.texts.scores(sentence)

    def explain(
        self, row: int, query: Query | Sentence, options: SearchOptions
    ) -> tuple[Evidence, ...]:
        """Return the evidence of each object of a scene, or of each statement of a text."""
        signature = self.entry(self.names[row]).signature
        if isinstance(query, Query):
            return explain_frames(self.index, row, signature, query, options)
        rooms = [a.get("room", "") for a in signature.attributes]
        return score(query, signature.graph, rooms, self.texts, signature.attributes).evidence

    def open_scenes(self, rows: Sequence[int]) -> SceneLibrary:  # noqa: ARG002  # all are here
        """Return the library itself: it has all scenes."""
        return self

    @property
    def index(self) -> Index:
        """Index of all signatures and those of `load_decoys`; `OptionError` for an empty library."""
        if not self._entries:
            raise OptionError("The library is empty; add a scene before searching it.")
        if self._index is None:
            signatures = [e.signature for e in self._entries.values()] + load_decoys(self.encoders)
            self._index = Index.of(signatures, [e.key for e in self.encoders])
        return self._index

    @property
    def own_index(self) -> Index:
        """The scenes alone, without the homes beside them."""
        if self._own is None:
            self._own = self.index.subset(np.flatnonzero(self.index.owner < len(self)))
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

    def live(self, camera: Camera | None = None, **options: Any) -> LiveTracker:  # noqa: ANN401
        """Return a tracker of the map and the pose in it at any time, as frames come.

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
            raise OptionError("The library is empty; add a scene before saving it.")
        folder, places = resolve_path(path).parent, []
        entries = list(self._entries.values())
        for name, entry in self._entries.items():
            if entry.path is None:
                raise OptionError(
                    f"{name!r} is a map in memory; save it, and add the saved file to the library."
                )
            places.append(os.path.relpath(resolve_path(entry.path), folder))
        meta = {
            "encoders": [{"name": e.name, "key": e.key} for e in self.encoders],
            "digests": [e.digest for e in entries],
            "earth": [[pose.to_dict() for pose in e.earth] for e in entries],
            "height": self.height,
            "grain": GRAIN,
        }
        arrays = {"names": pack_strings(self.names), "paths": pack_strings(places)}
        keys = [e.key for e in self.encoders]
        arrays |= pack_signatures([e.signature for e in entries], keys)
        write_map(path, KIND, VERSION, meta, arrays)

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        encoders: Encoders | None = None,
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
        if not Path(path).is_dir():
            return cls._of_file(path, encoders)
        paths = sorted(Path(path).glob(f"*{SUFFIX}"))
        if not paths:
            raise InputError(
                f"{path} is a folder that contains no scene map (*{SUFFIX}); name one map file, "
                "use `open_world` for cities, or build scene maps with `placegraph scene build`."
            )
        library, tell = cls() if encoders is None else cls(encoders), progress or (lambda *_: None)
        for i, file in enumerate(paths):
            tell("reading maps", i, len(paths))
            library.add(file.stem, file)
        tell("reading maps", len(paths), len(paths))
        return library

    @classmethod
    def _of_file(cls, path: str | os.PathLike[str], encoders: Encoders | None) -> SceneLibrary:
        file = read_map(path, KIND, VERSION)
        made = match_encoders(file, encoders)
        with check_contents(path, "Build the library again."):
            library = cls(made, height=file.meta["height"])
            names, places = file.strings("names"), file.strings("paths")
            digests = [str(digest) for digest in file.meta["digests"]]
            poses = [
                tuple(map(EarthPose.from_dict, found))
                for found in file.meta.get("earth", [[]] * len(names))
            ]
            signatures = read_signatures(file, [e.key for e in library.encoders])
            folder = resolve_path(path).parent
            for name, place, signature, digest, earth in zip(
                names, places, signatures, digests, poses, strict=True
            ):
                at = Path(os.path.normpath(folder / place))
                library.insert(name, Entry(signature, at, digest, earth))
        return library


def make_library(maps: Mapping[str, SceneMap], **options: Any) -> SceneLibrary:  # noqa: ANN401
    """Return a library of maps in memory; options are those of `SceneLibrary`."""
    library = SceneLibrary(**options)
    for name, scene in maps.items():
        library.add(name, scene)
    return library


def match_encoders(file: MapFile, given: Encoders | None) -> list[Encoder]:
    """Return the encoders of a file, made by name or given; `MapError` where these are others."""
    known = [] if given is None else [given] if isinstance(given, str | Encoder) else list(given)
    made = {e.key: e for e in (encoder(g) if isinstance(g, str) else g for g in known)}
    try:
        wanted = [(str(e["name"]), str(e["key"])) for e in file.meta["encoders"]]
    except (KeyError, TypeError) as error:
        raise MapError(
            f"{file.header.path}: the file lists no encoders. Build the library again."
        ) from error
    out = []
    for name, key in wanted:
        found = made.get(key)
        if found is None and name in ENCODERS:
            try:
                by_name = encoder(name)
            except (OptionError, MissingExtraError):  # it needs weights, or what is not installed
                by_name = None
            found = by_name if by_name is not None and by_name.key == key else None
        if found is None or (made and not made.keys() & {k for _, k in wanted}):
            here = ", ".join(made) or (found.key if found else "an unknown encoder")
            raise MapError(
                f"{file.header.path} was encoded by {key}, but the given encoder is {here}; "
                "open it with the original encoder (encoders=..., or --encoder and "
                "--weights), or build the library again."
            )
        out.append(found)
    return out


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal; `InputError` where they cannot be read."""
    try:
        return hashlib.sha256(check_regular(path).read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path} can no longer be read ({error.strerror}); restore it.") from error
