"""What the commands of `placegraph library` share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from placegraph.cli.command import Argument, Option
from placegraph.cli.encoders import encoders_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from placegraph.indoor.library import SceneLibrary

Library = Annotated[
    Path,
    Argument(metavar="LIBRARY", help="File that `library build` wrote, or folder of scene maps."),
]
Most = Annotated[int, Option(help="Scenes named at most.")]
Encoders = Annotated[
    list[str] | None,
    Option(
        "--encoder",
        help="What scenes are compared by; may be repeated: labels, appearance; features or "
        "scenegraphloc, of maps that `scene encode` gave their vectors. [default: labels and "
        "appearance]",
    ),
]
ItsEncoders = Annotated[
    list[str] | None,
    Option(
        "--encoder",
        help="Encoders of the library, all of them, where one has --weights of its own; of a folder "
        "of maps, what they are compared by. [default: those that the file names]",
    ),
]


def opened(
    path: Path,
    names: Sequence[str] | None,
    weights: Path | None,
    tell: Callable[[str, int, int], None] | None = None,
) -> SceneLibrary:
    """Library of a file or a folder of maps, with encoders that were asked for; else its own."""
    from placegraph.indoor.library import SceneLibrary

    encoders = encoders_of(names or [], weights)
    return SceneLibrary.open(path, encoders=encoders or None, progress=tell)
