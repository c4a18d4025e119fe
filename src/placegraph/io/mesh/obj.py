"""Reader of Wavefront OBJ meshes with their materials: objects, groups or materials as objects.

The text is told apart, counted and parsed by whole arrays, a block of some megabytes at a time; only
the few lines that name something (`o`, `g`, `usemtl`, `mtllib`) are looked at one by one.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import LabelEntry
from placegraph.io.mesh.model import (
    UNKNOWN,
    Z_UP,
    Model,
    ModelObject,
    Texture,
    read_bytes,
    triangulate_fans,
)

Rows = NDArray[np.int64]
Groups = Literal["auto", "o", "g", "usemtl"]

BLOCK = 1 << 24
_LONGEST_LINE = 1 << 22
_NEWLINE, _SPACE, _SLASH, _HASH = b"\n /#"
_SPACES = bytes.maketrans(b"\t\r\v\f\0", b"     ")
_NAMED = ("o", "g", "usemtl")  # keywords that say what the faces after them belong to
_OPTION_VALUES = {
    "-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-boost": 1,
    "-bm": 1, "-type": 1, "-colorspace": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3,
}  # fmt: skip
"""Maximum number of values after each option of a texture."""
_MOVING = ("-o", "-s", "-t")


def is_obj(path: Path) -> bool:
    """Return whether a path looks like an OBJ file."""
    return path.suffix.lower() == ".obj" and path.is_file()


def read_obj(
    path: str | PathLike[str],
    *,
    up: Literal["y", "z"] = "z",
    groups: Groups = "auto",
    table: Mapping[str, LabelEntry] | None = None,
) -> Model:
    """Read an OBJ mesh, its material files and their textures.

    Polygons become fans of triangles. Faces of one name are one object, wherever they stand; its id
    is the name, its label the name without a counter such as Blender's `.001`. Faces without a name
    are one object "unknown". Colours after coordinates are sRGB, 0 to 1 (or 0 to 255).

    Parameters
    ----------
    up
        Axis that points up in it.
    groups
        Which keyword parts the file into objects; auto: the first of `o`, `g` and `usemtl` that
        names two or more, else the first that names any.
    table
        What the names are called: `placegraph.io.capture.json_files.read_label_table`.

    Raises
    ------
    InputError
        The file is missing, holds no vertex, or a vertex or a face that is none; or a material
        file cannot be read.
    OptionError
        `groups` is none of its values.

    """
    if groups not in {"auto", *_NAMED}:
        raise OptionError(f"groups is {groups!r}; choose 'auto', 'o', 'g' or 'usemtl'.")
    parser = _Parser(Path(path))
    for block in _read_blocks(parser.path):
        parser.add(block)
    text = parser.join()
    corner, face = triangulate_fans(text.lengths)
    if degenerate := int((text.lengths < 3).sum()):
        text.left_out["faces of fewer than three corners"] += degenerate
    vertex, uv, triangles = _index_vertices(text, corner)
    keyword: str = groups
    if groups == "auto":
        named = [k for k in _NAMED if text.names[k]]
        several = [k for k in named if len(np.unique(text.name_of[k][face])) > 1]
        keyword = (several or named or ["o"])[0]
    used, object_of = np.unique(text.name_of[keyword][face], return_inverse=True)
    names = [text.names[keyword][i] if i >= 0 else "" for i in used.tolist()]
    pictures, picture_of = _read_textures(text, face)
    vertices = text.vertices[vertex]
    there = np.isfinite(text.colours).all(axis=1)
    colours = np.full(text.vertices.shape, 255, np.uint8)
    if there.any():
        share: NDArray[Any] = text.colours[there]
        share = share if share.max() > 1.0 else share * 255.0
        colours[there] = np.rint(np.clip(share, 0, 255)).astype(np.uint8)
        if not there.all():
            text.left_out["vertices without the colour that others have"] += int((~there).sum())
    return Model(
        path=text.path,
        objects=tuple(_make_object(name, (table or {}).get(name)) for name in names),
        vertices=vertices @ Z_UP.T if up == "y" else vertices,
        triangles=triangles,
        object_of=object_of.reshape(-1),
        colours=colours[vertex],
        uv=uv,
        picture_of=picture_of,
        pictures=pictures,
        left_out=text.left_out,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Text:
    """Columns of an OBJ file; rows count from 0."""

    path: Path
    vertices: Floats  # (V, 3)
    colours: NDArray[np.float32]  # (V, 3) as they stand after the coordinates, else NaN
    uv: Floats  # (U, 2), v up
    lengths: Rows  # (F,) corners of each face
    corners: Rows  # (C,) rows of vertices, face after face
    corner_uv: Rows  # (C,) rows of uv, -1: none
    names: dict[str, tuple[str, ...]]  # of `o`, `g` and `usemtl`, in their order
    name_of: dict[str, Rows]  # (F,) rows of names, -1: none
    libraries: list[str]
    left_out: Counter[str]


def _index_vertices(text: _Text, corner: Rows) -> tuple[Rows, Floats, Rows]:
    """Return the source vertex of each model vertex, texture coordinates (v down), and triangles.

    A vertex that faces give several texture coordinates is there as often.
    """
    count = len(text.vertices)
    rows, mapped = text.corners[corner], text.corner_uv[corner]
    if (mapped < 0).all():
        return np.arange(count), np.zeros((count, 2)), rows
    table = np.concatenate([text.uv * (1.0, -1.0) + (0.0, 1.0), np.zeros((1, 2))])  # -1: the last
    uv_of = np.zeros(count, np.int64)
    uv_of[rows] = mapped
    if (uv_of[rows] == mapped).all():  # no vertex has two texture coordinates
        uv = np.zeros((count, 2))
        uv[rows] = table[mapped]
        return np.arange(count), uv, rows
    pairs, triangles = np.unique(rows * len(table) + mapped + 1, return_inverse=True)
    return pairs // len(table), table[pairs % len(table) - 1], triangles.reshape(-1, 3)


def _make_object(name: str, entry: LabelEntry | None) -> ModelObject:
    if entry is not None:
        return ModelObject(name, entry.label, entry.name or name, entry.attributes)
    return ModelObject(name or UNKNOWN, re.sub(r"\.\d{3,}$", "", name) or UNKNOWN, name)


class _Lines(NamedTuple):
    """Some lines of a block, one after the other."""

    text: NDArray[np.uint8]  # without the keywords and comments
    starts: Rows
    rows: Rows  # which lines of the block they are

    def words(self) -> Rows:
        """Return the starts of words."""
        begins = (self.text != _SPACE) & (self.text != _NEWLINE)
        begins[1:] &= ~begins[:-1]
        return np.flatnonzero(begins)

    def count_in(self, places: Rows) -> Rows:
        """Return the number of these positions (ascending) in each line."""
        ends = np.append(self.starts[1:], len(self.text))
        return np.searchsorted(places, ends) - np.searchsorted(places, self.starts)


def _read_blocks(path: Path) -> Iterator[bytes]:
    """Yield complete lines, some megabytes at a time; a final backslash continues a line."""
    try:
        with check_regular(path).open("rb") as file:
            rest = file.read(3).removeprefix(b"\xef\xbb\xbf")
            while block := file.read(BLOCK):
                rest += block
                cut = rest.rfind(b"\n") + 1
                while cut and rest[:cut].rstrip(b"\r\n").endswith(b"\\"):
                    cut = rest.rfind(b"\n", 0, cut - 1) + 1
                if not cut and len(rest) > _LONGEST_LINE:
                    break
                yield rest[:cut]
                rest = rest[cut:]
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error
    if len(rest) > _LONGEST_LINE:
        raise InputError(f"{path} is not an OBJ file: it has no lines; export it again.")
    yield rest


@dataclass(slots=True)
class _Parser:
    """Columns of an OBJ file as they grow."""

    path: Path
    line: int = 0
    vertex_count: int = 0
    uv_count: int = 0
    parts: dict[str, list[NDArray[Any]]] = field(
        default_factory=lambda: {
            "vertices": [np.zeros((0, 3))],
            "colours": [np.zeros((0, 3), np.float32)],
            "uv": [np.zeros((0, 2))],
            **{k: [np.zeros(0, np.int64)] for k in ("lengths", "corners", "corner_uv", *_NAMED)},
        }
    )
    names: dict[str, dict[str, int]] = field(default_factory=lambda: {k: {} for k in _NAMED})
    current: dict[str, int] = field(default_factory=lambda: dict.fromkeys(_NAMED, -1))
    libraries: list[str] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)

    def add(self, block: bytes) -> None:
        if b"\\" in block:
            block = block.replace(b"\\\r\n", b"  ").replace(b"\\\n", b" ")
        block = block.translate(_SPACES)
        data = np.frombuffer(block if block.endswith(b"\n") else block + b"\n  ", np.uint8)
        ends = np.flatnonzero(data == _NEWLINE)
        starts = np.concatenate([[0], ends[:-1] + 1])
        first = starts.copy()
        for _ in range(64):  # indentation
            blank = data[first] == _SPACE
            if not blank.any():
                break
            first += blank
        last = len(data) - 1
        a, b, c = (data[np.minimum(first + i, last)] for i in range(3))
        is_vertex = (a == ord("v")) & (b == _SPACE)
        is_uv = (a == ord("v")) & (b == ord("t")) & (c == _SPACE)
        is_face = (a == ord("f")) & (b == _SPACE)

        def select(wanted: NDArray[np.bool_], keyword: int) -> _Lines:
            """Parse lines of one kind, whose keywords have so many letters."""
            lengths = ends - starts + 1
            text = data[: ends[-1] + 1 if len(ends) else 0][np.repeat(wanted, lengths)].copy()
            rows = np.flatnonzero(wanted)
            lengths = lengths[rows]
            begin = np.cumsum(lengths) - lengths
            for i in range(keyword):
                text[begin + (first - starts)[rows] + i] = _SPACE
            if _HASH in text:
                hashes = np.cumsum(text == _HASH)
                before = np.where(begin > 0, hashes[begin - 1], 0)
                text[(hashes > np.repeat(before, lengths)) & (text != _NEWLINE)] = _SPACE
            return _Lines(text, begin, rows)

        counts, at, numbers = self.read_rows(
            select(is_vertex, 1), 3, "a vertex must have three coordinates"
        )
        corners = at[:, None] + np.arange(3)
        coloured = counts >= 6  # x y z r g b; x y z w is without colour
        colours = np.full(corners.shape, np.nan, np.float32)
        colours[coloured] = numbers[corners[coloured] + (counts[coloured, None] - 3)]
        self.parts["vertices"].append(numbers[corners])
        self.parts["colours"].append(colours)
        counts, at, numbers = self.read_rows(
            select(is_uv, 2), 1, "a texture vertex must have u and v"
        )
        v = np.where(counts > 1, _parse_fields(numbers, at), 0.0)
        self.parts["uv"].append(np.stack([numbers[at], v], axis=1))
        faces = select(is_face, 1)
        self.add_faces(faces, np.cumsum(is_vertex), np.cumsum(is_uv))
        self.add_names(block, starts, ends, np.flatnonzero(np.isin(a, list(b"ogum"))), faces.rows)
        flat = int((((a == ord("l")) | (a == ord("p"))) & (b == _SPACE)).sum())
        if flat:
            self.left_out["lines and points, which have no surface"] += flat
        self.line += len(starts)
        self.vertex_count += int(is_vertex.sum())
        self.uv_count += int(is_uv.sum())

    def read_rows(self, lines: _Lines, least: int, what: str) -> tuple[Rows, Rows, Floats]:
        """Return the count of numbers of lines, the start of each line's, and all numbers."""
        words = lines.words()
        counts, numbers = lines.count_in(words), self.parse(lines, words, np.float64)
        short = np.flatnonzero(counts < least)
        if short.size:
            raise self.error(int(lines.rows[short[0]]), f"it is cut off: {what}")
        return counts, np.cumsum(counts) - counts, numbers

    def add_faces(self, lines: _Lines, vertices: Rows, uv: Rows) -> None:
        """Add corners `v`, `v/vt`, `v//vn` or `v/vt/vn`; negative ones count back from their line."""
        text = np.frombuffer(lines.text.tobytes().replace(b"//", b"/0/"), np.uint8).copy()
        ends = np.flatnonzero(text == _NEWLINE)
        lines = _Lines(text, np.append(0, ends + 1)[: len(ends)], lines.rows)
        corners, slashes = lines.words(), np.flatnonzero(text == _SLASH)
        more = np.diff(np.searchsorted(slashes, np.append(corners, len(text))))
        text[slashes] = _SPACE
        words = lines.words()
        numbers = self.parse(lines, words, np.int64, int)
        if len(words) != len(corners) + len(slashes):  # as of 1/ or /1
            raise self.error(int(lines.rows[0]), "after it a corner lacks a number beside its /")
        at = np.cumsum(1 + more) - (1 + more)
        lengths = lines.count_in(corners)
        row = np.repeat(lines.rows, lengths)
        corner = _resolve(numbers[at], self.vertex_count + vertices[row])
        mapped = np.where(more > 0, _parse_fields(numbers, at), 0)
        corner_uv = np.where(mapped == 0, -1, _resolve(mapped, self.uv_count + uv[row]))
        wrong = (corner < 0) | ((corner_uv < 0) & (mapped != 0))
        if wrong.any():
            raise self.error(int(row[wrong][0]), "a face refers to a missing vertex")
        for name, column in (("lengths", lengths), ("corners", corner), ("corner_uv", corner_uv)):
            self.parts[name].append(column)

    def add_names(self, block: bytes, starts: Rows, ends: Rows, rows: Rows, faces: Rows) -> None:
        """Add what the faces of a block belong to."""
        events: dict[str, tuple[list[int], list[int]]] = {
            k: ([-1], [self.current[k]]) for k in _NAMED
        }
        for row in rows.tolist():
            line = block[starts[row] : ends[row]].decode("utf-8", "replace").strip()
            keyword, _, name = line.partition(" ")
            name = name.strip()
            if keyword == "mtllib":
                self.libraries.append(name)
            elif keyword in _NAMED:
                if keyword == "g":  # of several groups the first
                    name = name.partition(" ")[0]
                known = self.names[keyword]
                events[keyword][0].append(row)
                events[keyword][1].append(known.setdefault(name, len(known)) if name else -1)
        for keyword, (lines, numbers) in events.items():
            place = np.searchsorted(np.array(lines), faces, side="right") - 1
            self.parts[keyword].append(np.array(numbers, np.int64)[place])
            self.current[keyword] = numbers[-1]

    def parse(self, lines: _Lines, words: Rows, dtype: type, parse: type = float) -> NDArray[Any]:
        """Return the number that begins at each of the words, which are all there are."""
        numbers: NDArray[Any] = np.zeros(0, dtype)
        if not len(words):
            return numbers
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)
            try:
                numbers = np.fromstring(lines.text.tobytes(), dtype, sep=" ")
            except (DeprecationWarning, ValueError):
                numbers = numbers[:0]
        if len(numbers) == len(words):
            return numbers
        ends = np.append(lines.starts[1:], len(lines.text))
        for row, start, end in zip(lines.rows, lines.starts, ends, strict=True):
            for word in lines.text[start:end].tobytes().split():
                try:
                    parse(word)
                except ValueError:
                    shown = word[:40].decode("utf-8", "replace")
                    raise self.error(int(row), f"{shown!r} is not a number") from None
        raise InputError(f"{self.path} contains a value that is not a number; export it again.")

    def error(self, row: int, what: str) -> InputError:
        return InputError(f"{self.path}, line {self.line + row + 1}: {what}; export it again.")

    def join(self) -> _Text:
        """Return all columns; raises `InputError` where faces name vertices that are not there."""
        joined = {}
        for name, parts in self.parts.items():
            joined[name] = np.concatenate(parts)
            parts.clear()
        if not len(joined["vertices"]):
            raise InputError(f"{self.path} contains no vertex; export it as an OBJ mesh.")
        for rows, count in (("corners", "vertices"), ("corner_uv", "uv")):
            if joined[rows].size and int(joined[rows].max()) >= len(joined[count]):
                raise InputError(
                    f"{self.path}: a face refers to {count} {int(joined[rows].max()) + 1} "
                    f"of {len(joined[count])}, so the file is truncated or damaged; export "
                    "it again."
                )
        return _Text(
            path=self.path,
            names={k: tuple(known) for k, known in self.names.items()},
            name_of={k: joined.pop(k) for k in _NAMED},
            libraries=self.libraries,
            left_out=self.left_out,
            **joined,
        )


def _parse_fields(numbers: NDArray[Any], at: Rows) -> NDArray[Any]:
    """Return the numbers after these positions."""
    after: NDArray[Any] = numbers[np.minimum(at + 1, max(len(numbers) - 1, 0))]
    return after


def _resolve(numbers: Rows, count: Rows) -> Rows:
    """Convert numbers from 1, or negative ones from the last, to rows from 0; negative: none."""
    return np.where(numbers > 0, numbers - 1, np.where(numbers < 0, count + numbers, -1))


def _read_textures(text: _Text, face: Rows) -> tuple[tuple[Texture, ...], Rows]:
    """Return the textures of the used materials, and the texture of each triangle.

    A texture that is missing leaves the material its `Kd`; a material that is missing is white.
    """
    used, of = np.unique(text.name_of["usemtl"][face], return_inverse=True)
    names = [text.names["usemtl"][i] if i >= 0 else None for i in used.tolist()]
    materials: dict[str, _Material] = {}
    # a line may name several files, or one whose name holds blanks
    for line in dict.fromkeys(text.libraries) if any(n is not None for n in names) else ():
        path = line.replace("\\", "/")
        for file in [path] if path.lower().count(".mtl") < 2 else path.split():
            library = text.path.parent / file
            if file and library.is_file():
                materials = _read_materials(library, text.left_out) | materials
            elif file:
                text.left_out["material files that are missing"] += 1
    rows: dict[Texture, int] = {}
    row_of = []
    for name in names:
        picture = Texture(None)
        if name in materials:
            picture = _make_texture(materials[name], text.left_out)
        elif name is not None:
            text.left_out["materials missing in the material files"] += 1
        row_of.append(rows.setdefault(picture, len(rows)))
    return tuple(rows) or (Texture(None),), np.array(row_of, np.int64)[of.reshape(-1)]


@dataclass(slots=True)
class _Material:
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)  # taken as sRGB: so do viewers show it
    picture: Path | None = None


def _read_materials(path: Path, left_out: Counter[str]) -> dict[str, _Material]:
    """Read materials of an .mtl file: `Kd` and `map_Kd`; `InputError` for invalid colours."""
    lines = read_bytes(path).decode("utf-8-sig", "replace").splitlines()
    materials: dict[str, _Material] = {}
    current = _Material()
    for number, line in enumerate(lines, 1):
        keyword, _, rest = line.strip().partition(" ")
        rest = rest.strip()
        if keyword == "newmtl":
            current = materials.setdefault(rest, _Material())
        elif keyword == "Kd":
            current.factor = _parse_colour(path, number, rest)
        elif keyword == "map_Kd":
            if any(option in rest.split() for option in _MOVING):
                left_out["textures whose offset or scale was not applied"] += 1
            name = _skip_options(rest).strip('"').replace("\\", "/")
            try:
                there = (path.parent / name).is_file()
            except (OSError, ValueError):  # too long, or with a null byte
                there = False
            # of a path from another machine the last part is tried beside the file
            file = path.parent / (name if there else name.rsplit("/", 1)[-1])
            current.picture = file if name else None
    return materials


def _parse_colour(path: Path, number: int, text: str) -> tuple[float, float, float]:
    words = text.partition("#")[0].split()
    if words[:1] in (["spectral"], ["xyz"]):
        return 1.0, 1.0, 1.0
    try:
        r, g, b = (min(max(float(w), 0.0), 1.0) for w in (words * 3 if len(words) == 1 else words))
    except ValueError as error:
        raise InputError(
            f"{path}, line {number}: Kd is {text[:40]!r}; it must be three numbers from 0 to 1."
        ) from error
    return r, g, b


def _skip_options(text: str) -> str:
    """Return `map_Kd` without its options; file names may hold blanks."""
    while text:
        word, _, after = text.partition(" ")
        if word not in _OPTION_VALUES:
            break
        text = after.strip()
        for i in range(_OPTION_VALUES[word]):
            value, _, after = text.partition(" ")
            if i and word in _MOVING:  # they have one to three numbers
                try:
                    float(value)
                except ValueError:
                    break
            text = after.strip()
    return text


def _make_texture(material: _Material, left_out: Counter[str]) -> Texture:
    # linear intensities of sRGB (IEC 61966-2-1)
    r, g, b = (
        c / 12.92 if c <= 0.04045 else float(((c + 0.055) / 1.055) ** 2.4) for c in material.factor
    )
    data = None
    if material.picture is not None:
        try:
            data = check_regular(material.picture).read_bytes()
        except (OSError, ValueError):
            left_out["textures that are missing"] += 1
    if data is None:
        return Texture(None, (r, g, b))
    if r == g == b == 0.0:  # beside a texture that means nothing, as some exporters have it
        r = g = b = 1.0
    return Texture(data, (r, g, b), name=str(material.picture))
