"""The library: many scene maps, and the question which of them a capture was taken in."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from placegraph.core.estimate import PoseEstimate, SceneEstimate
from placegraph.core.files import real_path
from placegraph.core.geo import EarthPose
from placegraph.core.geometry import Camera
from placegraph.core.mapfile import MapFile, pack_strings, read_map, sound, write_map
from placegraph.core.pickling import Shown
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError
from placegraph.indoor.encode import ENCODERS, Encoder, encoder
from placegraph.indoor.library.answer import Many, search
from placegraph.indoor.library.localize import localize
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.library.scenes import Entry, Scenes
from placegraph.indoor.library.signature_file import GRAIN, KIND, VERSION, columns, signatures_in
from placegraph.indoor.scene_map import SceneMap
from placegraph.indoor.track.live import LiveTracker
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

Progress = Callable[[str, int, int], None]


SUFFIX = ".scene"
"""Of the maps in a folder."""


class Asked:
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


class SceneLibrary(Asked, Shown, Scenes):
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
