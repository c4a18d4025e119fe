"""Encoders as command lines name them: --encoder NAME, and --weights FILE for one that has some."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from placegraph.cli.command import Option
from placegraph.errors import OptionError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.indoor.encode import Encoder

WITH_WEIGHTS = ("features", "scenegraphloc")
"""Encoders that read a file of weights."""
WITH_CAPTURES = ("features", "scenegraphloc")
"""Encoders that know objects by images of the map."""

WeightsFile = Annotated[
    Path | None,
    Option(
        "--weights",
        help="File with the weights of the encoder: needed by scenegraphloc (`scene train` writes "
        "some), fetched by features if not given.",
    ),
]


def encoders_of(names: Sequence[str], weights: Path | None) -> list[Encoder]:
    """Encoders by name, the one that has weights with those of a file.

    Raises
    ------
    OptionError
        There is none of a name, or weights belong to none of them or to several.
    InputError, MapError, MissingExtraError, ServiceError
        As the encoders themselves.

    """
    from placegraph.indoor.encode import encoder, spoken

    own = [name for name in names if spoken(name)[0] in WITH_WEIGHTS]
    if weights is not None and len(own) != 1:
        raise OptionError(
            f"--weights belongs to one encoder that has some ({', '.join(WITH_WEIGHTS)}), and "
            f"{', '.join(names) or 'none'} was named; name it by --encoder, and no second one."
        )
    return [
        encoder(name, weights=weights) if weights is not None and name in own else encoder(name)
        for name in names
    ]
