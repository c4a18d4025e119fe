"""Wavefront material files (.mtl) as pictures: `Kd` and `map_Kd`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from placegraph.core.files import regular
from placegraph.errors import InputError
from placegraph.io.mesh.model import Picture

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
