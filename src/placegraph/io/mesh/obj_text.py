"""The text of Wavefront OBJ files as columns, a block of some megabytes at a time.

What the columns mean for a map is `obj`'s. Lines are told apart, counted and parsed by whole
arrays; only the few that name things (`o`, `g`, `usemtl`, `mtllib`) are looked at one by one.
"""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.mesh.obj_lines import (
    NEWLINE,
    SLASH,
    SPACE,
    Lines,
    blocks,
    following,
    lines_of,
    resolved,
)

Bytes = NDArray[np.uint8]
Rows = NDArray[np.int64]


_SPACES = bytes.maketrans(b"\t\r\v\f\0", b"     ")
NAMED = ("o", "g", "usemtl")
"""Keywords that say what the faces after them belong to."""


@dataclass(frozen=True, slots=True, eq=False)
class ObjText:
    """What an OBJ file says; rows count from 0."""

    path: Path
    vertices: NDArray[np.float64]
    """(V, 3)"""
    colours: NDArray[np.float32]
    """(V, 3) as they stand after the coordinates, NaN where they do not."""
    uv: NDArray[np.float64]
    """(U, 2), v up."""
    lengths: Rows
    """(F,) corners of each face."""
    corners: Rows
    """(C,) rows of vertices, face after face."""
    corner_uv: Rows
    """(C,) rows of uv, -1: none."""
    names: dict[str, tuple[str, ...]]
    """Of `o`, `g` and `usemtl`: names in their order."""
    name_of: dict[str, Rows]
    """(F,) rows of names, -1: none."""
    libraries: tuple[str, ...]
    left_out: Counter[str]


def read_obj_text(path: Path) -> ObjText:
    """Read an OBJ file.

    Raises `InputError` where it is missing, unreadable, without a vertex, or holds a vertex or a
    face that is none; the message names the line.
    """
    text = _Text(path)
    for block in blocks(path):
        text.add(block)
    return text.columns()


@dataclass(slots=True)
class _Text:
    """Columns as they grow."""

    path: Path
    line: int = 0
    vertex_count: int = 0
    uv_count: int = 0
    parts: dict[str, list[NDArray[Any]]] = field(
        default_factory=lambda: {
            name: []
            for name in ("vertices", "colours", "uv", "lengths", "corners", "corner_uv", *NAMED)
        }
    )
    names: dict[str, dict[str, int]] = field(default_factory=lambda: {k: {} for k in NAMED})
    current: dict[str, int] = field(default_factory=lambda: dict.fromkeys(NAMED, -1))
    libraries: list[str] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, block: bytes) -> None:
        if b"\\" in block:
            block = block.replace(b"\\\r\n", b"  ").replace(b"\\\n", b" ")
        block = block.translate(_SPACES)
        data = np.frombuffer(block if block.endswith(b"\n") else block + b"\n  ", np.uint8)
        ends = np.flatnonzero(data == NEWLINE)
        starts = np.concatenate([[0], ends[:-1] + 1])
        first = starts.copy()
        for _ in range(64):  # indentation
            blank = data[first] == SPACE
            if not blank.any():
                break
            first += blank
        last = len(data) - 1
        a, b, c = (data[np.minimum(first + i, last)] for i in range(3))
        is_vertex = (a == ord("v")) & (b == SPACE)
        is_uv = (a == ord("v")) & (b == ord("t")) & (c == SPACE)
        is_face = (a == ord("f")) & (b == SPACE)
        lines = (data, starts, first, ends)
        self._vertices(lines_of(*lines, is_vertex, 1))
        self._uv(lines_of(*lines, is_uv, 2))
        faces = lines_of(*lines, is_face, 1)
        self._faces(faces, np.cumsum(is_vertex), np.cumsum(is_uv))
        self._named(block, starts, ends, np.flatnonzero(np.isin(a, list(b"ogum"))), faces.rows)
        flat = int((((a == ord("l")) | (a == ord("p"))) & (b == SPACE)).sum())
        if flat:
            self.left_out["lines and points, which have no surface"] += flat
        self.line += len(starts)
        self.vertex_count += int(is_vertex.sum())
        self.uv_count += int(is_uv.sum())

    def _vertices(self, lines: Lines) -> None:
        words = lines.words()
        counts, numbers = lines.held(words), self._numbers(lines, words, np.float64)
        self._enough(lines, counts, 3, "a vertex has three coordinates")
        at = (np.cumsum(counts) - counts)[:, None] + np.arange(3)
        coloured = counts >= 6  # x y z r g b; x y z w is without colour
        self.parts["vertices"].append(numbers[at])
        colours = np.full(at.shape, np.nan, np.float32)
        colours[coloured] = numbers[at[coloured] + (counts[coloured, None] - 3)]
        self.parts["colours"].append(colours)

    def _uv(self, lines: Lines) -> None:
        words = lines.words()
        counts, numbers = lines.held(words), self._numbers(lines, words, np.float64)
        self._enough(lines, counts, 1, "a texture vertex has u and v")
        at = np.cumsum(counts) - counts
        v = np.where(counts > 1, following(numbers, at), 0.0)
        self.parts["uv"].append(np.stack([numbers[at], v], axis=1))

    def _faces(self, lines: Lines, vertices: Rows, uv: Rows) -> None:
        """Corners `v`, `v/vt`, `v//vn` or `v/vt/vn`; negative ones count back from their line."""
        text = np.frombuffer(lines.text.tobytes().replace(b"//", b"/0/"), np.uint8).copy()
        ends = np.flatnonzero(text == NEWLINE)
        lines = Lines(text, np.append(0, ends + 1)[: len(ends)], lines.rows)
        corners, slashes = lines.words(), np.flatnonzero(text == SLASH)
        more = np.diff(np.searchsorted(slashes, np.append(corners, len(text))))
        text[slashes] = SPACE
        words = lines.words()
        numbers = self._numbers(lines, words, np.int64, int)
        if len(words) != len(corners) + len(slashes):  # as of 1/ or /1
            raise self._error(int(lines.rows[0]), "after it a corner lacks a number beside its /")
        at = np.cumsum(1 + more) - (1 + more)
        lengths = lines.held(corners)
        row = np.repeat(lines.rows, lengths)
        corner = resolved(numbers[at], self.vertex_count + vertices[row])
        mapped = np.where(more > 0, following(numbers, at), 0)
        corner_uv = np.where(mapped == 0, -1, resolved(mapped, self.uv_count + uv[row]))
        wrong = (corner < 0) | ((corner_uv < 0) & (mapped != 0))
        if wrong.any():
            raise self._error(int(row[wrong][0]), "a face names a vertex that is not there")
        self.parts["lengths"].append(lengths)
        self.parts["corners"].append(corner)
        self.parts["corner_uv"].append(corner_uv)

    def _named(self, block: bytes, starts: Rows, ends: Rows, rows: Rows, faces: Rows) -> None:
        """What the faces of a block belong to."""
        events: dict[str, tuple[list[int], list[int]]] = {
            k: ([-1], [self.current[k]]) for k in NAMED
        }
        for row in rows.tolist():
            line = block[starts[row] : ends[row]].decode("utf-8", "replace").strip()
            keyword, _, name = line.partition(" ")
            name = name.strip()
            if keyword == "mtllib":
                self.libraries.append(name)
            elif keyword in NAMED:
                if keyword == "g":  # of several groups the first
                    name = name.partition(" ")[0]
                known = self.names[keyword]
                number = known.setdefault(name, len(known)) if name else -1
                events[keyword][0].append(row)
                events[keyword][1].append(number)
        for keyword, (lines, numbers) in events.items():
            place = np.searchsorted(np.array(lines), faces, side="right") - 1
            self.parts[keyword].append(np.array(numbers, np.int64)[place])
            self.current[keyword] = numbers[-1]

    def _numbers(self, lines: Lines, words: Rows, dtype: type, parse: type = float) -> NDArray[Any]:
        """The number that begins at each of the words, which are all there are."""
        if not len(words):
            return np.zeros(0, dtype)
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            try:
                numbers: NDArray[Any] = np.fromstring(lines.text.tobytes(), dtype, sep=" ")
            except (DeprecationWarning, ValueError):
                raise self._nonsense(lines, parse) from None
        if len(numbers) != len(words):
            raise self._nonsense(lines, parse)
        return numbers

    def _nonsense(self, lines: Lines, parse: type = float) -> InputError:
        """Error that names the first line among these that holds what is no number."""
        ends = np.append(lines.starts[1:], len(lines.text))
        for row, start, end in zip(lines.rows, lines.starts, ends, strict=True):
            for word in lines.text[start:end].tobytes().split():
                try:
                    parse(word)
                except ValueError:
                    shown = word[:40].decode("utf-8", "replace")
                    return self._error(int(row), f"{shown!r} is no number")
        return InputError(f"{self.path} holds what is no number; export it again.")

    def _enough(self, lines: Lines, counts: Rows, least: int, what: str) -> None:
        short = np.flatnonzero(counts < least)
        if short.size:
            raise self._error(int(lines.rows[short[0]]), f"it is cut off: {what}")

    def _error(self, row: int, what: str) -> InputError:
        return InputError(f"{self.path}, line {self.line + row + 1}: {what}; export it again.")

    def columns(self) -> ObjText:
        shapes: dict[str, tuple[tuple[int, ...], type]] = {
            "vertices": ((0, 3), np.float64),
            "colours": ((0, 3), np.float32),
            "uv": ((0, 2), np.float64),
        }
        joined = {}
        for name, parts in self.parts.items():
            shape, kind = shapes.get(name, ((0,), np.int64))
            joined[name] = np.concatenate([np.zeros(shape, kind), *parts])
            parts.clear()
        if not len(joined["vertices"]):
            raise InputError(f"{self.path} holds no vertex; export it as an OBJ mesh.")
        for rows, count in (("corners", "vertices"), ("corner_uv", "uv")):
            if joined[rows].size and int(joined[rows].max()) >= len(joined[count]):
                raise InputError(
                    f"{self.path}: a face names {count} {int(joined[rows].max()) + 1} of "
                    f"{len(joined[count])}; it is truncated or damaged: export it again."
                )
        return ObjText(
            path=self.path,
            vertices=joined["vertices"],
            colours=joined["colours"],
            uv=joined["uv"],
            lengths=joined["lengths"],
            corners=joined["corners"],
            corner_uv=joined["corner_uv"],
            names={k: tuple(known) for k, known in self.names.items()},
            name_of={k: joined[k] for k in NAMED},
            libraries=tuple(self.libraries),
            left_out=self.left_out,
        )
