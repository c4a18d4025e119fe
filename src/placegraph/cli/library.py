"""Commands `placegraph library ...`."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import (
    AsJson,
    console,
    echo_json,
    evidence_cells,
    progress_of,
    show_facts,
    table,
)
from placegraph.cli.scene_localize import MOST_OBJECTS, show
from placegraph.cli.scene_options import (
    CaptureFolder,
    Device,
    Frames,
    NoProgress,
    Seed,
    WeightsFile,
    chosen_frames,
    encoders_of,
)
from placegraph.errors import InputError, MapError, OptionError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from placegraph.core.estimate import SceneEstimate
    from placegraph.indoor.library import SceneLibrary
    from placegraph.indoor.library.search import SceneCollection

Library = Annotated[
    Path,
    Argument(metavar="LIBRARY", help="File that `library build` wrote, or folder of scene maps."),
]
Most = Annotated[int, Option(help="Maximum number of scenes to list.")]
Encoders = Annotated[
    list[str] | None,
    Option(
        "--encoder",
        help="Encoder that compares scenes; may be repeated: labels, appearance, or, for maps "
        "prepared with `scene encode`, features or scenegraphloc. [default: labels and "
        "appearance]",
    ),
]
ItsEncoders = Annotated[
    list[str] | None,
    Option(
        "--encoder",
        help="Encoders of the library: list all of them if one needs --weights. For a folder of "
        "maps: encoders to compare them by. [default: those named in the file]",
    ),
]


def open_library(
    path: Path,
    names: Sequence[str] | None,
    weights: Path | None,
    tell: Callable[[str, int, int], None] | None = None,
) -> SceneLibrary:
    """Library of a file or a folder of maps, with encoders that were asked for; else its own."""
    from placegraph.indoor.library import SceneLibrary

    encoders = encoders_of(names or [], weights)
    return SceneLibrary.open(path, encoders=encoders or None, progress=tell)


def build(
    maps: Annotated[list[Path], Argument(help="Scene maps (.scene), or folders of them.")],
    out: Annotated[Path, Option("--out", "-o", help="Library file to write.")],
    encoder: Encoders = None,
    weights: WeightsFile = None,
    height: Annotated[
        float | None, Option(help="Height of the cameras above the floor [m].")
    ] = None,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Make a library of scene maps: a few kilobytes a scene, searched in milliseconds.

    The library stores the relative path of each map; scenes are named by their files. Maps that cannot
    be added are reported on stderr and left out.

    Example: placegraph library build maps/ -o homes.library

    Example: placegraph library build encoded/ -o homes.library --encoder scenegraphloc
    --weights mine.safetensors
    """
    from placegraph.core.mapfile import map_writer
    from placegraph.indoor.library import SceneLibrary

    paths = _named([path for given in maps for path in _maps(given)])
    with map_writer(out):
        pass  # a place that cannot be written to is refused now, not when all is read
    made = encoders_of(encoder or [], weights)
    library = SceneLibrary(made, height=height) if made else SceneLibrary(height=height)
    with progress_of(hidden=quiet or as_json) as tell:
        failed = _add_all(library, paths, tell)
    for path, error in failed.items():
        click.echo(f"{path} was skipped: {error}", err=True)
    if not len(library):
        raise next(iter(failed.values()))
    library.save(out)
    _print_facts(library, out, as_json=as_json, skipped=len(failed))


def add(
    library: Library,
    scene: Annotated[Path, Argument(help="Scene map (.scene).")],
    name: Annotated[
        str | None, Option(help="Name of the scene; the file name if not given.")
    ] = None,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
) -> None:
    """Add a scene map to a library's file.

    Example: placegraph library add homes.library attic.scene --name attic
    """
    known = _file(library, encoder, weights)
    known.add(name or scene.stem, scene)
    known.save(library)
    _print_facts(known, library, as_json=as_json)


def remove(
    library: Library,
    name: Annotated[str, Argument(help="Name of the scene.")],
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
) -> None:
    """Take a scene out of a library's file; its map stays.

    Example: placegraph library remove homes.library attic
    """
    known = _file(library, encoder, weights)
    known.remove(name)
    known.save(library)
    _print_facts(known, library, as_json=as_json)


def info(
    library: Library,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
) -> None:
    """Show the contents of a library.

    Example: placegraph library info homes.library
    """
    _print_facts(open_library(library, encoder, weights), library, as_json=as_json)


def facts(library: SceneLibrary) -> dict[str, object]:
    """Summarize a library."""
    signatures = [library.entry(name).signature for name in library]
    rooms = {room for s in signatures for room in s.rooms if not room.isdigit()}
    return {
        "scenes": len(library),
        "names": list(library.names[:12]) + (["..."] if len(library) > 12 else []),
        "encoders": [e.key for e in library.encoders],
        "objects": sum(len(s) for s in signatures),
        "rooms": sorted(rooms)[:12],
    }


def _print_facts(library: SceneLibrary, path: Path, *, as_json: bool, skipped: int = 0) -> None:
    summary = facts(library)
    if path.is_file():
        size = path.stat().st_size
        summary |= {"bytes": size, "bytes_a_scene": round(size / max(1, len(library)))}
    if skipped or as_json:
        summary["skipped"] = skipped
    if as_json:
        echo_json(summary)
    else:
        show_facts(summary)


def _add_all(
    library: SceneLibrary, paths: dict[str, Path], tell: Callable[[str, int, int], None]
) -> dict[Path, InputError | MapError | OptionError]:
    """Add maps by name; returns why some could not be."""
    failed: dict[Path, InputError | MapError | OptionError] = {}
    for i, (name, path) in enumerate(paths.items()):
        tell(f"reading {path.name}", i, len(paths))
        try:
            library.add(name, path)
        except (InputError, MapError, OptionError) as error:
            failed[path] = error
    return failed


def _named(paths: list[Path]) -> dict[str, Path]:
    """Maps by the names of their files; the same file given twice counts once.

    Raises `OptionError` where two files have one name, `InputError` where one is not there.
    """
    named: dict[str, Path] = {}
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist; build it with `placegraph scene build`.")
        other = named.setdefault(path.stem, path)
        if other.resolve() != path.resolve():
            raise OptionError(
                f"{other} and {path} have the same name {path.stem!r}; rename one, or add "
                "it later with `library add --name`."
            )
    return named


def _maps(given: Path) -> list[Path]:
    """Scene maps of a folder, or the file itself."""
    from placegraph.indoor.library.library import SUFFIX

    if not given.is_dir():
        return [given]
    found = sorted(given.glob(f"*{SUFFIX}"))
    if not found:
        raise InputError(
            f"{given} contains no scene map (*{SUFFIX}); build one with `placegraph scene build`."
        )
    return found


def _file(path: Path, names: list[str] | None, weights: Path | None) -> SceneLibrary:
    """Library of a file; of a folder there is none to write to."""
    if path.is_dir():
        raise OptionError(
            f"{path} is a folder; copy maps into it, or make a library file with `placegraph "
            "library build`."
        )
    return open_library(path, names, weights)


_FILE = re.compile(r"\.[A-Za-z][A-Za-z0-9]{0,9}$")


def search(
    library: Library,
    query: Annotated[
        str | None,
        Argument(
            help="Capture (folder or recording) or description ('a kitchen with two sinks'). "
            "Text with a slash or a file ending is taken for a capture."
        ),
    ] = None,
    text: Annotated[str | None, Option(help="Description of the place, in place of QUERY.")] = None,
    frames: Frames = None,
    most: Most = 5,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Find the scene that a capture was taken in, or that a text describes.

    OK: use the answer. AMBIGUOUS: several scenes fit. LOST: no scene fits.

    Examples: placegraph library search homes.library walk/ --frames :10;
    placegraph library search homes.library "a kitchen with two sinks";
    placegraph library search homes.library --text "a sofa and/or a bed"
    """
    from placegraph.io.capture.capture import open_capture

    asked = _parse_query(query, text)
    if isinstance(asked, str) and frames is not None:
        raise OptionError(
            f"--frames applies only to captures, but {asked!r} is not a file or folder; check "
            "the path, or remove --frames."
        )
    with progress_of(hidden=quiet or as_json) as tell:
        # the capture first: a library of a folder takes its time
        capture = None if isinstance(asked, str) else chosen_frames(open_capture(asked), frames)
        known = _open_collection(library, encoder, weights, tell)
        tell("searching", 0, 1)
        estimate = known.search(str(asked) if capture is None else capture, most=most)
    if query is not None and capture is None and len(query.split()) == 1:
        click.echo(f"{query!r} is not a file or folder, so it is read as a description.", err=True)
    if as_json:
        echo_json(estimate.to_dict())
    else:
        show_scenes(estimate)


def localize(
    library: Library,
    capture: CaptureFolder,
    frames: Frames = None,
    most: Annotated[int, Option(help="Maximum number of scenes to localize in.")] = 8,
    description: Annotated[
        str | None,
        Option(help="Description of the camera's place: 'next to the sofa, facing the window'."),
    ] = None,
    refine: Annotated[
        bool, Option("--refine/--no-refine", help="Fit the pose to depth and images.")
    ] = True,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Find the scene that a capture was taken in, and the pose in its map.

    The likeliest scenes are tried one after another. The pose is in the map of the reported scene.

    Example: placegraph library localize homes.library walk/ --frames :10
    """
    from placegraph.io.capture.capture import open_capture

    chosen = chosen_frames(open_capture(capture), frames)
    with progress_of(hidden=quiet or as_json) as tell:
        estimate = _open_collection(library, encoder, weights, tell).localize(
            chosen, most=most, description=description, refine=refine, seed=seed, device=device,
            progress=tell,
        )  # fmt: skip
    if as_json:
        echo_json(estimate.to_dict())
    else:
        show(estimate)


def _open_collection(
    path: Path,
    names: list[str] | None,
    weights: Path | None,
    tell: Callable[[str, int, int], None],
) -> SceneCollection:
    """Library of a file or a folder, or shards."""
    from placegraph.cli.scene_options import encoders_of
    from placegraph.maps import is_shards, open_folder

    if is_shards(path):
        made = encoders_of(names or [], weights)
        library: SceneCollection = open_folder(path, encoders=made or None)
        return library
    return open_library(path, names, weights, tell)


def _parse_query(query: str | None, text: str | None) -> Path | str:
    """Capture that QUERY names, or the text of either.

    Raises `OptionError`: not one of both is given, or there is nothing in it; `InputError`: QUERY
    is no text, and no file or folder either.
    """
    if (query is None) == (text is None):
        raise OptionError(
            "The query must be given once: a capture or a text as QUERY, or a text with --text."
        )
    given = query if text is None else text
    if given is None or not given.strip():
        raise OptionError("The query is empty; name a capture, or describe a place in words.")
    if text is not None:
        return text
    try:
        there = Path(given).exists()
    except (OSError, ValueError):  # too long for a name, or of characters that none has
        there = False
    if there:
        return Path(given)
    if "/" in given or _FILE.search(given):
        raise InputError(
            f"{given} does not exist; check the path, or give a description with --text."
        )
    return given


def show_scenes(estimate: SceneEstimate) -> None:
    """Print which scenes fit, and why the best does."""
    out = console()
    out.print(f"{estimate.status.name}: {estimate.reason}")
    width = max((len(mode.scene) for mode in estimate.modes), default=0)
    for rank, mode in enumerate(estimate.modes, 1):
        out.print(f"{rank}. {mode.scene:{width}}  {mode.probability:6.1%}")
    if estimate.evidence:
        rows = table("", "evidence", "log-likelihood ratio")
        for e in estimate.evidence[: MOST_OBJECTS + 2]:
            rows.add_row(*evidence_cells(e))
        out.print(rows)
