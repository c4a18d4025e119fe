"""Faces for lettering: Pillow's own where it suffices, else one of the system's."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache, lru_cache

from PIL import ImageFont

FACES = ("", "DejaVuSans.ttf", "NotoSans-Regular.ttf", "LiberationSans-Regular.ttf", "Arial.ttf")
"""Files by preference; the empty one is Pillow's built-in face, which knows little beyond ASCII."""
LONGEST = 1000
"""Letters of a text that are drawn."""

_PLAIN = str.maketrans({"ß": "ss", "ı": "i", "ø": "o", "ł": "l", "đ": "d", "æ": "ae", "œ": "oe",
                        "Ø": "O", "Ł": "L", "Đ": "D", "–": "-", "—": "-", "’": "'", "“": '"',
                        "”": '"', "„": '"', "…": "...", "•": "·"})  # fmt: skip


@dataclass(frozen=True)
class Face:
    """A typeface."""

    file: str

    def font(self, size: float) -> ImageFont.FreeTypeFont:
        """Font of a size [px]."""
        return _font(self.file, max(1, round(size)))

    def width(self, text: str, size: float) -> float:
        """Width of a text [px]."""
        return self.font(32).getlength(self.drawable(text)) * size / 32

    def draws(self, text: str) -> bool:
        """Whether the face has every letter of a text."""
        return all(_has(self.file, letter) for letter in set(text) if not letter.isspace())

    def drawable(self, text: str) -> str:
        """Return the text, without accents where the face lacks them; "" where that is no help.

        Of a longer text as many letters as the widest picture has room for: drawing costs by letters.
        """
        text = text[:LONGEST]
        if self.draws(text):
            return text
        apart = unicodedata.normalize("NFKD", text.translate(_PLAIN))
        plain = "".join(letter for letter in apart if not unicodedata.combining(letter))
        return plain if self.draws(plain) else ""


@cache
def _installed() -> tuple[Face, ...]:
    """Faces that can be opened here."""
    found = []
    for file in FACES:
        try:
            _font(file, 16)
        except OSError:
            continue
        found.append(Face(file))
    return tuple(found)


def face_for(texts: Iterable[str]) -> Face:
    """Return the first face that has every letter of all texts, or that draws most of them."""
    wanted = list(texts)
    return max(_installed(), key=lambda face: sum(map(face.draws, wanted)))


@lru_cache(maxsize=256)
def _font(file: str, size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.truetype(file, size) if file else ImageFont.load_default(size)
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise OSError("this Pillow was built without FreeType; install Pillow's own wheel")
    return font


@lru_cache(maxsize=8192)
def _has(file: str, letter: str) -> bool:
    """Whether a letter has a picture of its own, other than that of a letter that is missing."""
    font = _font(file, 16)
    return bytes(font.getmask(letter)) != bytes(font.getmask("\U0010ffff"))
