"""Commands of libraries: `placegraph library ...`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from placegraph.cli.common import AsJson, show_facts
from placegraph.cli.scene_answer import MOST_OBJECTS, progress_of, show
from placegraph.cli.scene_query import (
    CaptureFolder,
    Device,
    Frames,
    NoProgress,
    Seed,
    chosen_frames,
)
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from placegraph.estimate import SceneEstimate
    from placegraph.indoor.library import SceneLibrary

app = typer.Typer(
    help="Many scene maps: in which of them was a capture taken, or which does a text describe?",
    no_args_is_help=True,
)

Library = Annotated[
    Path,
    typer.Argument(
        metavar="LIBRARY", help="File that `library build` wrote, or folder of scene maps."
    ),
]
Most = Annotated[int, typer.Option(help="Scenes named at most.")]
Encoders = Annotated[
    list[str] | None,
    typer.Option(
        "--encoder",
        help="What scenes are compared by; may be repeated: labels, appearance, compact. "
        "[default: labels and appearance]",
    ),
]


@app.command()
def build(
    maps: Annotated[list[Path], typer.Argument(help="Scene maps (.scene), or folders of them.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Library file to write.")],
    encoder: Encoders = None,
    height: Annotated[
        float | None, typer.Option(help="Height of the cameras above the floor [m].")
    ] = None,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Make a library of scene maps: a few kilobytes a scene, searched in milliseconds.

    The maps stay where they are; the library knows them by their place relative to itself, and by
    the names of their files.

    Example: placegraph library build maps/ -o homes.library
    """
    from placegraph.indoor.library import SceneLibrary

    library = SceneLibrary(encoder, height=height) if encoder else SceneLibrary(height=height)
    paths = [path for given in maps for path in _maps(given)]
    with progress_of(hidden=quiet or as_json) as tell:
        for i, path in enumerate(paths):
            tell(f"reading {path.name}", i, len(paths))
            library.add(path.stem, path)
    library.save(out)
    _say(library, out, as_json=as_json)


@app.command()
def add(
    library: Library,
    scene: Annotated[Path, typer.Argument(help="Scene map (.scene).")],
    name: Annotated[
        str | None, typer.Option(help="Its name; that of the file if not given.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Add a scene map to a library's file.

    Example: placegraph library add homes.library attic.scene --name attic
    """
    known = _file(library)
    known.add(name or scene.stem, scene)
    known.save(library)
    _say(known, library, as_json=as_json)


@app.command()
def remove(
    library: Library,
    name: Annotated[str, typer.Argument(help="Name of the scene.")],
    as_json: AsJson = False,
) -> None:
    """Take a scene out of a library's file; its map stays.

    Example: placegraph library remove homes.library attic
    """
    known = _file(library)
    known.remove(name)
    known.save(library)
    _say(known, library, as_json=as_json)


@app.command()
def info(library: Library, as_json: AsJson = False) -> None:
    """Say what a library holds.

    Example: placegraph library info homes.library
    """
    _say(_open(library), library, as_json=as_json)


@app.command()
def search(
    library: Library,
    query: Annotated[
        str, typer.Argument(help="Folder of a capture, or a text: 'a kitchen with two sinks'.")
    ],
    frames: Frames = None,
    most: Most = 5,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Find the scene that a capture was taken in, or that a text describes.

    OK is to be trusted; AMBIGUOUS names several scenes that fit, LOST says that none does.

    Examples: placegraph library search homes.library walk/ --frames :10;
    placegraph library search homes.library "a kitchen with two sinks"
    """
    from placegraph.formats.capture import open_capture

    is_capture = Path(query).exists()
    if frames is not None and not is_capture:
        raise OptionError(f"--frames belongs to a capture, and {query!r} is no file or folder.")
    with progress_of(hidden=quiet or as_json) as tell:
        known = _open(library, tell)
        tell("searching", 0, 1)
        asked = chosen_frames(open_capture(Path(query)), frames) if is_capture else query
        estimate = known.search(asked, most=most)
    if as_json:
        typer.echo(json.dumps(estimate.to_dict(), ensure_ascii=False))
    else:
        show_scenes(estimate)


@app.command()
def localize(
    library: Library,
    capture: CaptureFolder,
    frames: Frames = None,
    most: Annotated[int, typer.Option(help="Scenes localized in at most.")] = 4,
    description: Annotated[
        str | None,
        typer.Option(help="What is known of the place: 'next to the sofa, facing the window'."),
    ] = None,
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Fit the pose to depth and images.")
    ] = True,
    seed: Seed = 0,
    device: Device = "auto",
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Find the scene that a capture was taken in, and the pose in its map.

    The likeliest scenes are searched together; the pose is in the map of the scene named.

    Example: placegraph library localize homes.library walk/ --frames :10
    """
    from placegraph.formats.capture import open_capture

    chosen = chosen_frames(open_capture(capture), frames)
    with progress_of(hidden=quiet or as_json) as tell:
        estimate = _open(library, tell).localize(
            chosen, most=most, description=description, refine=refine, seed=seed, device=device,
            progress=tell,
        )  # fmt: skip
    if as_json:
        typer.echo(json.dumps(estimate.to_dict(), ensure_ascii=False))
    else:
        show(estimate)


def show_scenes(estimate: SceneEstimate) -> None:
    """Print which scenes fit, and why the best does."""
    console = Console(soft_wrap=True, highlight=False, markup=False, emoji=False)
    console.print(f"{estimate.status.name}: {estimate.reason}")
    for rank, mode in enumerate(estimate.modes, 1):
        console.print(f"{rank}. {mode.scene}  {mode.probability:6.1%}")
    if estimate.evidence:
        table = Table("", "evidence", "nat", box=None, pad_edge=False)
        for e in estimate.evidence[: MOST_OBJECTS + 2]:
            sign = {"for": "+", "against": "-"}.get(e.verdict, " ")
            table.add_row(sign, e.statement, f"{e.weight:+.1f}")
        console.print(table)


def facts(library: SceneLibrary) -> dict[str, object]:
    """What a library holds."""
    signatures = [library.entry(name).signature for name in library]
    rooms = {room for s in signatures for room in s.rooms if not room.isdigit()}
    return {
        "scenes": len(library),
        "names": list(library.names[:12]) + (["..."] if len(library) > 12 else []),
        "encoders": [e.key for e in library.encoders],
        "objects": sum(len(s) for s in signatures),
        "rooms": sorted(rooms)[:12],
    }


def _say(library: SceneLibrary, path: Path, *, as_json: bool) -> None:
    told = facts(library)
    if path.is_file():
        size = path.stat().st_size
        told |= {"bytes": size, "bytes_a_scene": round(size / max(1, len(library)))}
    if as_json:
        typer.echo(json.dumps(told, ensure_ascii=False))
    else:
        show_facts(told)


def _maps(given: Path) -> list[Path]:
    """Scene maps of a folder, or the file itself."""
    from placegraph.errors import InputError
    from placegraph.indoor.library.library import SUFFIX

    if not given.is_dir():
        return [given]
    found = sorted(given.glob(f"*{SUFFIX}"))
    if not found:
        raise InputError(f"{given} holds no scene map (*{SUFFIX}); build some first.")
    return found


def _open(path: Path, tell: object = None) -> SceneLibrary:
    from placegraph.indoor.library import SceneLibrary

    return SceneLibrary.open(path, progress=tell if callable(tell) else None)


def _file(path: Path) -> SceneLibrary:
    """Library of a file; of a folder there is none to write to."""
    if path.is_dir():
        raise OptionError(f"{path} is a folder: put maps into it, or make a file of it by `build`.")
    return _open(path)
