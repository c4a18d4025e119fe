"""`placegraph library build`, `add`, `remove` and `info`: which scenes a library knows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, echo_json, progress_of, show_facts
from placegraph.cli.encoders import WeightsFile, encoders_of
from placegraph.cli.library.options import Encoders, ItsEncoders, Library, opened
from placegraph.cli.scene.query import NoProgress
from placegraph.errors import InputError, MapError, OptionError

if TYPE_CHECKING:
    from collections.abc import Callable

    from placegraph.indoor.library import SceneLibrary


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

    The maps stay where they are; the library knows them by their place relative to itself, and by
    the names of their files. A map that cannot be added is named on stderr and left out.

    Example: placegraph library build maps/ -o homes.library

    Example: placegraph library build encoded/ -o homes.library --encoder scenegraphloc
    --weights mine.safetensors
    """
    from placegraph.core.mapfile import writing
    from placegraph.indoor.library import SceneLibrary

    paths = _named([path for given in maps for path in _maps(given)])
    with writing(out):
        pass  # a place that cannot be written to is refused now, not when all is read
    made = encoders_of(encoder or [], weights)
    library = SceneLibrary(made, height=height) if made else SceneLibrary(height=height)
    with progress_of(hidden=quiet or as_json) as tell:
        failed = _add_all(library, paths, tell)
    for path, error in failed.items():
        click.echo(f"{path} is left out: {error}", err=True)
    if not len(library):
        raise next(iter(failed.values()))
    library.save(out)
    _say(library, out, as_json=as_json, skipped=len(failed))


def add(
    library: Library,
    scene: Annotated[Path, Argument(help="Scene map (.scene).")],
    name: Annotated[str | None, Option(help="Its name; that of the file if not given.")] = None,
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
    _say(known, library, as_json=as_json)


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
    _say(known, library, as_json=as_json)


def info(
    library: Library,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
) -> None:
    """Say what a library holds.

    Example: placegraph library info homes.library
    """
    _say(opened(library, encoder, weights), library, as_json=as_json)


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


def _say(library: SceneLibrary, path: Path, *, as_json: bool, skipped: int = 0) -> None:
    told = facts(library)
    if path.is_file():
        size = path.stat().st_size
        told |= {"bytes": size, "bytes_a_scene": round(size / max(1, len(library)))}
    if skipped or as_json:
        told["skipped"] = skipped
    if as_json:
        echo_json(told)
    else:
        show_facts(told)


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
                f"{other} and {path} are both called {path.stem!r}; rename one, or add it later by "
                "`library add --name`."
            )
    return named


def _maps(given: Path) -> list[Path]:
    """Scene maps of a folder, or the file itself."""
    from placegraph.indoor.library.library import SUFFIX

    if not given.is_dir():
        return [given]
    found = sorted(given.glob(f"*{SUFFIX}"))
    if not found:
        raise InputError(f"{given} holds no scene map (*{SUFFIX}); build some first.")
    return found


def _file(path: Path, names: list[str] | None, weights: Path | None) -> SceneLibrary:
    """Library of a file; of a folder there is none to write to."""
    if path.is_dir():
        raise OptionError(f"{path} is a folder: put maps into it, or make a file of it by `build`.")
    return opened(path, names, weights)
