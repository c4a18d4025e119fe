"""`placegraph library search` and `library localize`: in which scene something was seen."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from placegraph.cli.command import Argument, Option
from placegraph.cli.common import AsJson, console, echo_json, progress_of, table
from placegraph.cli.encoders import WeightsFile
from placegraph.cli.library.options import ItsEncoders, Library, Most, opened
from placegraph.cli.scene.answer import MOST_OBJECTS, show
from placegraph.cli.scene.query import (
    CaptureFolder,
    Device,
    Frames,
    NoProgress,
    Seed,
    chosen_frames,
)
from placegraph.errors import InputError, OptionError

if TYPE_CHECKING:
    from collections.abc import Callable

    from placegraph.core.estimate import SceneEstimate
    from placegraph.indoor.library import SceneLibrary
    from placegraph_scale.library.shards import SceneShards

_FILE = re.compile(r"\.[A-Za-z][A-Za-z0-9]{0,9}$")


def search(
    library: Library,
    query: Annotated[
        str | None,
        Argument(
            help="Capture: its folder, or a recorder's file; or a text: 'a kitchen with two sinks'. "
            "What has a slash, or ends like a file, is a capture."
        ),
    ] = None,
    text: Annotated[
        str | None, Option(help="A text, whatever it looks like, instead of QUERY.")
    ] = None,
    frames: Frames = None,
    most: Most = 5,
    encoder: ItsEncoders = None,
    weights: WeightsFile = None,
    as_json: AsJson = False,
    quiet: NoProgress = False,
) -> None:
    """Find the scene that a capture was taken in, or that a text describes.

    OK is to be trusted; AMBIGUOUS names several scenes that fit, LOST says that none does.

    Examples: placegraph library search homes.library walk/ --frames :10;
    placegraph library search homes.library "a kitchen with two sinks";
    placegraph library search homes.library --text "a sofa and/or a bed"
    """
    from placegraph.io.capture.capture import open_capture

    asked = _asked(query, text)
    if isinstance(asked, str) and frames is not None:
        raise OptionError(f"--frames belongs to a capture, and {asked!r} is no file or folder.")
    with progress_of(hidden=quiet or as_json) as tell:
        # the capture first: a library of a folder takes its time
        capture = None if isinstance(asked, str) else chosen_frames(open_capture(asked), frames)
        known = _known(library, encoder, weights, tell)
        tell("searching", 0, 1)
        estimate = known.search(str(asked) if capture is None else capture, most=most)
    if query is not None and capture is None and len(query.split()) == 1:
        click.echo(f"No file or folder is called {query!r}: it was taken for a text.", err=True)
    if as_json:
        echo_json(estimate.to_dict())
    else:
        show_scenes(estimate)


def localize(
    library: Library,
    capture: CaptureFolder,
    frames: Frames = None,
    most: Annotated[int, Option(help="Scenes localized in at most.")] = 8,
    description: Annotated[
        str | None,
        Option(help="What is known of the place: 'next to the sofa, facing the window'."),
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

    The likeliest scenes are looked into one after another; the pose is in the map of the scene named.

    Example: placegraph library localize homes.library walk/ --frames :10
    """
    from placegraph.io.capture.capture import open_capture

    chosen = chosen_frames(open_capture(capture), frames)
    with progress_of(hidden=quiet or as_json) as tell:
        estimate = _known(library, encoder, weights, tell).localize(
            chosen, most=most, description=description, refine=refine, seed=seed, device=device,
            progress=tell,
        )  # fmt: skip
    if as_json:
        echo_json(estimate.to_dict())
    else:
        show(estimate)


def _known(
    path: Path,
    names: list[str] | None,
    weights: Path | None,
    tell: Callable[[str, int, int], None],
) -> SceneLibrary | SceneShards:
    """Library of a file or a folder, or shards."""
    from placegraph.cli.encoders import encoders_of
    from placegraph.maps import is_shards
    from placegraph_scale.library.shards import SceneShards

    if is_shards(path):
        return SceneShards.open(path, encoders=encoders_of(names or [], weights) or None)
    return opened(path, names, weights, tell)


def _asked(query: str | None, text: str | None) -> Path | str:
    """Capture that QUERY names, or the text of either.

    Raises
    ------
    OptionError
        Not one of both is given, or there is nothing in it.
    InputError
        QUERY is no text, and no file or folder either.

    """
    if (query is None) == (text is None):
        raise OptionError("Give a capture or a text as QUERY, or a text by --text; one of them.")
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
            f"{given} does not exist; if it is no capture but words, put a text in --text."
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
        rows = table("", "evidence", "nat")
        for e in estimate.evidence[: MOST_OBJECTS + 2]:
            sign = {"for": "+", "against": "-"}.get(e.verdict, " ")
            rows.add_row(sign, e.statement, f"{e.weight:+.1f}")
        out.print(rows)
