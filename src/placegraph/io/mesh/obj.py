"""Reader of Wavefront OBJ meshes with their materials: objects, groups or materials as objects."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import LabelEntry
from placegraph.io.mesh.model import Z_UP
from placegraph.io.mesh.model import Model, Picture, Thing
from placegraph.io.mesh.model import UNKNOWN

_OPTION_VALUES = {
    "-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-boost": 1,
    "-bm": 1, "-type": 1, "-colorspace": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3,
}  # fmt: skip
"""How many values, at most, follow an option of a texture."""
_MOVING = ("-o", "-s", "-t")


@dataclass(slots=True)
class _Material:
    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """As the file says it, which is taken as sRGB: so do viewers show it."""
    picture: Path | None = None


def read_materials(
    libraries: Iterable[Path], wanted: Iterable[str], left_out: Counter[str]
) -> dict[str, Picture]:
    """Pictures of the materials that are wanted, by name; what is missing is counted.

    A texture that is missing leaves the material its `Kd`; a material that is missing is not in the
    answer. `Kd 0 0 0` beside a texture means nothing, as some exporters have it. Raises
    `InputError` where a library is there but cannot be read, or holds a colour that is no number.
    """
    materials: dict[str, _Material] = {}
    for library in libraries:
        if library.is_file():
            for name, material in _read(library, left_out).items():
                materials.setdefault(name, material)
        else:
            left_out["material files that are missing"] += 1
    found: dict[str, Picture] = {}
    for name in wanted:
        if name in materials:
            found[name] = _picture(materials[name], left_out)
        else:
            left_out["materials that no material file holds"] += 1
    return found


def _read(path: Path, left_out: Counter[str]) -> dict[str, _Material]:
    try:
        lines = regular(path).read_text(encoding="utf-8-sig", errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    materials: dict[str, _Material] = {}
    current = _Material()
    for number, line in enumerate(lines, 1):
        keyword, _, rest = line.strip().partition(" ")
        rest = rest.strip()
        if keyword == "newmtl":
            current = materials.setdefault(rest, _Material())
        elif keyword == "Kd":
            current.factor = _colour(path, number, rest)
        elif keyword == "map_Kd":
            words = rest.split()
            if any(option in words for option in _MOVING):
                left_out["textures whose offset or scale was not applied"] += 1
            name = _file_name(rest)
            current.picture = _find(path.parent, name) if name else None
    return materials


def _colour(path: Path, number: int, rest: str) -> tuple[float, float, float]:
    words = rest.partition("#")[0].split()
    if words[:1] in (["spectral"], ["xyz"]):
        return 1.0, 1.0, 1.0
    try:
        r, g, b = (min(max(float(w), 0.0), 1.0) for w in (words * 3 if len(words) == 1 else words))
    except ValueError as error:
        raise InputError(
            f"{path}, line {number}: Kd is {rest[:40]!r}; it must be three numbers from 0 to 1."
        ) from error
    return r, g, b


def _file_name(rest: str) -> str:
    """What remains of `map_Kd` without its options; a file's name may hold blanks."""
    while rest:
        word, _, after = rest.partition(" ")
        if word not in _OPTION_VALUES:
            break
        rest = after.strip()
        for i in range(_OPTION_VALUES[word]):
            value, _, after = rest.partition(" ")
            if i and word in _MOVING and not _is_number(value):  # they have one to three numbers
                break
            rest = after.strip()
    return rest


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _find(folder: Path, name: str) -> Path:
    """Texture by its name; of a path from another machine the last part is tried beside the file."""
    name = name.strip('"').replace("\\", "/")
    try:
        there = (folder / name).is_file()
    except (OSError, ValueError):  # too long, or with a null byte
        there = False
    return folder / name if there else folder / name.rsplit("/", 1)[-1]


def _picture(material: _Material, left_out: Counter[str]) -> Picture:
    r, g, b = (_linear(channel) for channel in material.factor)
    data = None
    if material.picture is not None:
        try:
            data = regular(material.picture).read_bytes()
        except (OSError, ValueError):
            left_out["textures that are missing"] += 1
    if data is None:
        return Picture(None, (r, g, b))
    if r == g == b == 0.0:
        r = g = b = 1.0
    return Picture(data, (r, g, b), name=str(material.picture))


def _linear(channel: float) -> float:
    """Linear intensity of an sRGB value (IEC 61966-2-1)."""
    return channel / 12.92 if channel <= 0.04045 else float(((channel + 0.055) / 1.055) ** 2.4)


Bytes = NDArray[np.uint8]
Rows = NDArray[np.int64]


BLOCK = 1 << 24
_LONGEST_LINE = 1 << 22
NEWLINE, SPACE, SLASH, _HASH = b"\n /#"


class Lines(NamedTuple):
    """Some lines of a block, one after the other."""

    text: Bytes  # Without the keywords and comments
    starts: Rows
    rows: Rows  # Which lines of the block they are

    def words(self) -> Rows:
        """Where words begin."""
        begins = (self.text != SPACE) & (self.text != NEWLINE)
        begins[1:] &= ~begins[:-1]
        return np.flatnonzero(begins)

    def held(self, places: Rows) -> Rows:
        """How many of these places (ascending) each line holds."""
        ends = np.append(self.starts[1:], len(self.text))
        return np.searchsorted(places, ends) - np.searchsorted(places, self.starts)


def blocks(path: Path) -> Iterator[bytes]:
    """Whole lines, some megabytes at a time; a line that ends with a backslash goes on."""
    try:
        with regular(path).open("rb") as file:
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


def lines_of(
    data: Bytes, starts: Rows, first: Rows, ends: Rows, wanted: NDArray[np.bool_], keyword: int
) -> Lines:
    """Lines of one kind; `first` is where their keywords of so many letters stand."""
    rows = np.flatnonzero(wanted)
    lengths = (ends - starts + 1)[rows]
    text = data[: ends[-1] + 1 if len(ends) else 0][np.repeat(wanted, ends - starts + 1)].copy()
    begin = np.cumsum(lengths) - lengths
    for i in range(keyword):
        text[begin + (first - starts)[rows] + i] = SPACE
    if _HASH in text:
        hashes = np.cumsum(text == _HASH)
        before = np.where(begin > 0, hashes[begin - 1], 0)
        text[(hashes > np.repeat(before, lengths)) & (text != NEWLINE)] = SPACE
    return Lines(text, begin, rows)


def following(numbers: NDArray[Any], at: Rows) -> NDArray[Any]:
    """Numbers after these places, or any where there is none."""
    after: NDArray[Any] = numbers[np.minimum(at + 1, max(len(numbers) - 1, 0))]
    return after


def resolved(numbers: Rows, count: Rows) -> Rows:
    """Rows from 0 of numbers from 1, or of negative ones from the last; negative: none."""
    return np.where(numbers > 0, numbers - 1, np.where(numbers < 0, count + numbers, -1))


_SPACES = bytes.maketrans(b"\t\r\v\f\0", b"     ")
NAMED = ("o", "g", "usemtl")  # Keywords that say what the faces after them belong to


@dataclass(frozen=True, slots=True, eq=False)
class ObjText:
    """What an OBJ file says; rows count from 0."""

    path: Path
    vertices: NDArray[np.float64]  # (V, 3)
    colours: NDArray[np.float32]
    """(V, 3) as they stand after the coordinates, NaN where they do not."""
    uv: NDArray[np.float64]  # (U, 2), v up
    lengths: Rows  # (F,) corners of each face
    corners: Rows  # (C,) rows of vertices, face after face
    corner_uv: Rows  # (C,) rows of uv, -1: none
    names: dict[str, tuple[str, ...]]  # Of `o`, `g` and `usemtl`: names in their order
    name_of: dict[str, Rows]  # (F,) rows of names, -1: none
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


Groups = Literal["auto", "o", "g", "usemtl"]


def is_obj(path: Path) -> bool:
    """Whether a path looks like an OBJ file."""
    return path.suffix.lower() == ".obj" and path.is_file()


def read_obj(
    path: str | PathLike[str],
    *,
    up: Literal["y", "z"] = "z",
    groups: Groups = "auto",
    table: Mapping[str, LabelEntry] | None = None,
) -> Model:
    """Read an OBJ mesh, its material files and their textures.

    Polygons become fans of triangles. Faces of one name are one thing, wherever they stand; its id
    is the name, its label the name without a counter such as Blender's `.001`. Faces without a name
    are one thing "unknown". Colours after coordinates are sRGB, 0 to 1 (or 0 to 255).

    Parameters
    ----------
    up
        Axis that points up in it.
    groups
        Which keyword parts the file into things; auto: the first of `o`, `g` and `usemtl` that
        names two or more, else the first that names any.
    table
        What the names are called: `placegraph.io.capture.labels.label_table`.

    Raises
    ------
    InputError
        The file is missing, holds no vertex, or a vertex or a face that is none; or a material
        file cannot be read.
    OptionError
        `groups` is none of its values.

    """
    if groups not in {"auto", *NAMED}:
        raise OptionError(f"groups is {groups!r}; it is 'auto', 'o', 'g' or 'usemtl'.")
    text = read_obj_text(Path(path))
    left_out = text.left_out
    corner, face = fans(text.lengths)
    degenerate = int((text.lengths < 3).sum())
    if degenerate:
        left_out["faces of fewer than three corners"] += degenerate
    vertex, uv, triangles = _shared(text, corner)
    things, thing_of = _things(text, groups, face, table or {})
    pictures, picture_of = _pictures(text, face, left_out)
    vertices = text.vertices[vertex]
    return Model(
        path=text.path,
        things=things,
        vertices=vertices @ Z_UP.T if up == "y" else vertices,
        triangles=triangles,
        thing_of=thing_of,
        colours=_colours(text, left_out)[vertex],
        uv=uv,
        picture_of=picture_of,
        pictures=pictures,
        left_out=left_out,
    )


def fans(lengths: Rows) -> tuple[Rows, Rows]:
    """Triangles (T, 3) of polygons as fans, in rows of all their corners, and the polygon of each.

    `lengths`: (F,) corners of each polygon, whose corners stand one polygon after the other.
    """
    count = np.maximum(lengths - 2, 0)
    face = np.repeat(np.arange(len(lengths)), count)
    step = np.arange(len(face)) - np.repeat(np.cumsum(count) - count, count)
    first = (np.cumsum(lengths) - lengths)[face]
    return np.stack([first, first + step + 1, first + step + 2], axis=1), face


def _shared(text: ObjText, corner: Rows) -> tuple[Rows, NDArray[np.float64], Rows]:
    """Vertex of each of the model's vertices, its texture coordinates (v down), and triangles.

    A vertex that faces give several texture coordinates is there as often.
    """
    rows, mapped = text.corners[corner], text.corner_uv[corner]
    if (mapped < 0).all():
        return np.arange(len(text.vertices)), np.zeros((len(text.vertices), 2)), rows
    table = np.concatenate([text.uv * (1.0, -1.0) + (0.0, 1.0), np.zeros((1, 2))])  # -1: the last
    if _one_each(rows, mapped, len(text.vertices)):
        uv = np.zeros((len(text.vertices), 2))
        uv[rows] = table[mapped]
        return np.arange(len(text.vertices)), uv, rows
    pairs, triangles = np.unique(rows * len(table) + mapped + 1, return_inverse=True)
    return pairs // len(table), table[pairs % len(table) - 1], triangles.reshape(-1, 3)


def _one_each(rows: Rows, mapped: Rows, count: int) -> bool:
    """Whether no vertex has two texture coordinates."""
    of = np.zeros(count, np.int64)
    of[rows] = mapped
    return bool((of[rows] == mapped).all())


def _things(
    text: ObjText, groups: Groups, face: Rows, table: Mapping[str, LabelEntry]
) -> tuple[tuple[Thing, ...], Rows]:
    """Things, and the thing of each triangle."""
    keyword = groups if groups != "auto" else _parting(text, face)
    names, name_of = text.names[keyword], text.name_of[keyword][face]
    used = np.unique(name_of)
    things = tuple(_thing(names[i] if i >= 0 else "", table) for i in used.tolist())
    return things, np.searchsorted(used, name_of)


def _parting(text: ObjText, face: Rows) -> str:
    """Keyword that parts the triangles into things."""
    named = [k for k in NAMED if text.names[k]]
    several = [k for k in named if len(np.unique(text.name_of[k][face])) > 1]
    return (several or named or ["o"])[0]


def _thing(name: str, table: Mapping[str, LabelEntry]) -> Thing:
    entry = table.get(name)
    if entry is not None:
        return Thing(name, entry.label, entry.name or name, entry.attributes)
    return Thing(name or UNKNOWN, re.sub(r"\.\d{3,}$", "", name) or UNKNOWN, name)


def _pictures(
    text: ObjText, face: Rows, left_out: Counter[str]
) -> tuple[tuple[Picture, ...], Rows]:
    """Pictures of the materials that are used, and the picture of each triangle."""
    material = text.name_of["usemtl"][face]
    used = np.unique(material)
    wanted = [text.names["usemtl"][i] for i in used.tolist() if i >= 0]
    libraries = _libraries(text) if wanted else []
    found = read_materials(libraries, wanted, left_out) if libraries else {}
    if wanted and not libraries:
        left_out["materials that no material file holds"] += len(wanted)
    rows: dict[Picture, int] = {}
    row_of = []
    for i in used.tolist():
        picture = found.get(text.names["usemtl"][i]) if i >= 0 else None
        row_of.append(rows.setdefault(picture or Picture(None), len(rows)))
    return tuple(rows) or (Picture(None),), np.array(row_of, np.int64)[
        np.searchsorted(used, material)
    ]


def _libraries(text: ObjText) -> list[Path]:
    """Material files: a line may name several, or one whose name holds blanks."""
    folder, found = text.path.parent, []
    for line in dict.fromkeys(text.libraries):
        whole = line.replace("\\", "/")
        names = [whole] if whole.lower().count(".mtl") < 2 else whole.split()
        found += [folder / name for name in names if name]
    return found


def _colours(text: ObjText, left_out: Counter[str]) -> NDArray[np.uint8]:
    """(V, 3) sRGB; white where there are none."""
    there = np.isfinite(text.colours).all(axis=1)
    colours = np.full(text.vertices.shape, 255, np.uint8)
    if there.any():
        share: NDArray[Any] = text.colours[there]
        share = share if share.max() > 1.0 else share * 255.0
        colours[there] = np.rint(np.clip(share, 0, 255)).astype(np.uint8)
        if not there.all():
            left_out["vertices without the colour that others have"] += int((~there).sum())
    return colours
