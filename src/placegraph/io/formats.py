"""File formats of captures and of sources of scene maps: how each is recognized and read.

The reader of a format X is a module with `is_X(path)`, which looks at file names alone, unless the
ending says enough, and `read_X(path, **options)`. Plugins add formats by entry points.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from placegraph.errors import OptionError


class Format(NamedTuple):
    """Format of a recorder, a data set or another program, and its reader."""

    name: str
    contents: str
    """Files that it is recognized by, for messages; may be empty."""
    module: str
    """Module of the reader, imported when it is needed."""
    verb: str
    """X of the reader's `is_X` and `read_X`."""
    takes: tuple[str, ...] = ()
    """Options of the reader."""
    ending: str = ""
    """Ending of its files, in lower case; empty where `is_X` decides."""
    rank: int = 0
    """Order in which formats are tried: distinctive ones have low ranks."""
    is_graph: bool = False
    """Whether it is another program's scene graph."""

    def __str__(self) -> str:
        return f"{self.name} ({self.contents})" if self.contents else self.name

    def matches(self, path: Path) -> bool:
        """Return whether a path looks like this format."""
        if self.ending:
            return path.suffix.lower() == self.ending
        try:
            return bool(getattr(import_module(self.module), f"is_{self.verb}")(path))
        except OSError:  # the path may not be read
            return False

    def read(self, path: Path, options: Mapping[str, Any], ignored: Collection[str] = ()) -> Any:  # noqa: ANN401  # a capture or a model
        """Read a path with those of the options that the reader takes.

        Raises `OptionError` for other options, unless they are `ignored`.
        """
        if unknown := options.keys() - {*self.takes, *ignored}:
            known = f"; it has {', '.join(self.takes)}" if self.takes else ""
            raise OptionError(f"{', '.join(sorted(unknown))}: not an option of {self.name}{known}.")
        taken = {name: value for name, value in options.items() if name in self.takes}
        return getattr(import_module(self.module), f"read_{self.verb}")(path, **taken)
