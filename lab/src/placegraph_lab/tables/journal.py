"""A long benchmark that may be cut: every answer is written down at once, and not asked for again.

An answer holds for the code, the data and the options that gave it: a fingerprint of the source
stands in its key, so that a change of the code asks everything anew.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import placegraph
import placegraph_lab

PACKAGES = tuple(Path(str(p.__file__)).parent for p in (placegraph, placegraph_lab))
INDOOR = (
    "placegraph/*.py", "placegraph/formats/**/*.py", "placegraph/indoor/**/*.py",
    "placegraph/indoor/**/data/*",
)  # fmt: skip
"""Code of the library that decides what indoor answers and maps are."""


def fingerprint(patterns: Iterable[str]) -> str:
    """Sixteen hexadecimal digits of the files that match, by name and content.

    `patterns` are globs that begin with a package: `placegraph/indoor/**/*.py`. `ValueError` where
    one matches no file, so that code which has moved is not silently left out.
    """
    digest = hashlib.sha256()
    found: dict[str, Path] = {}
    for pattern in patterns:
        package, _, below = pattern.partition("/")
        root = next(path for path in PACKAGES if path.name == package)
        here = {p.relative_to(root.parent).as_posix(): p for p in root.glob(below) if p.is_file()}
        if not here:
            raise ValueError(f"{pattern} matches no file of {root}.")
        found |= here
    for name in sorted(found):
        digest.update(name.encode() + b"\0")
        digest.update(hashlib.sha256(found[name].read_bytes()).digest())
    return digest.hexdigest()[:16]


class Journal:
    """Rows of JSON by key, one line each, appended as they come.

    A line that was cut short by an interruption is passed over.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows: dict[str, Any] = {}
        if not path.exists():
            return
        text = path.read_text(encoding="utf-8")
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._rows[entry["key"]] = entry["row"]
            except (ValueError, KeyError, TypeError):
                continue
        if text and not text.endswith("\n"):
            with path.open("a", encoding="utf-8") as file:
                file.write("\n")

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def __getitem__(self, key: str) -> Any:  # noqa: ANN401  # what was put there
        return self._rows[key]

    def __len__(self) -> int:
        return len(self._rows)

    def missing(self, keys: Iterable[str]) -> list[int]:
        """Places of the keys of which there is no row yet."""
        return [i for i, key in enumerate(keys) if key not in self]

    def filled(
        self,
        keys: Sequence[str],
        ask: Callable[[int], Any],
        *,
        warm: Callable[[], object] = lambda: None,
        tick: Callable[[], object] = lambda: None,
    ) -> list[Any]:
        """Rows of all keys; those that are missing are asked for by their place in `keys`.

        Each is written down at once, and `tick` called. `warm` is called before the first, so that
        what is timed is compiled.
        """
        for n, i in enumerate(self.missing(keys)):
            if not n:
                warm()
            self.put(keys[i], ask(i))
            tick()
        return [self[key] for key in keys]

    def put(self, key: str, row: Any) -> None:  # noqa: ANN401  # anything JSON holds
        """Write a row down, now."""
        line = json.dumps({"key": key, "row": row}, allow_nan=False)
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        self._rows[key] = row
